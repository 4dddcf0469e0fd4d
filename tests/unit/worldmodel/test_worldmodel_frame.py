"""The grip's frame: its rotation, what turning the whole world does, what a training makes of it."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from held_bar import DT_S, GRAVITY_M_S2, SMALL, episode, graph
from scipy.spatial.transform import Rotation

from physworld.worldmodel import PublishedModel, affine_skin
from physworld.worldmodel.dataset import read_track
from physworld.worldmodel.export import example_inputs, torch_program
from physworld.worldmodel.model.config import TrainingConfig
from physworld.worldmodel.model.frame import GripFrame, enter, grip_frame, leave, turns_ahead, turns_of
from physworld.worldmodel.model.inertia import InertialPrior
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.priors.choose import TURNED, choose, fit_priors, prior_error, spec_for
from physworld.worldmodel.rollout import rollout
from physworld.worldmodel.training import train

pytestmark = pytest.mark.slow

GRAVITY = np.array([0.0, 0.0, -9.81])
SHAPES = {
    "in space": np.random.default_rng(0).normal(size=(8, 3)),
    "in a plane": np.random.default_rng(1).normal(size=(6, 3)) * [1.0, 1.0, 0.0],
    "nearly on a line": np.random.default_rng(2).normal(size=(6, 3)) * [1.0, 0.02, 0.02],
}


def made(shape: np.ndarray) -> GripFrame:
    frame = grip_frame(shape, GRAVITY, DT_S)
    assert frame is not None
    return frame


@pytest.mark.parametrize("shape", SHAPES)
def test_the_frame_turns_as_rigid_grips_do(shape: str) -> None:
    frame = made(0.02 * SHAPES[shape] + [0.3, -0.2, 1.0])
    turns = Rotation.random(50, random_state=3).as_matrix()
    controls = np.einsum("tij,cj->tci", turns, frame.shape) + np.linspace(-1.0, 1.0, 50)[:, None, None]
    assert np.abs(turns_of(frame, controls) - turns).max() < 1e-10


def test_of_points_on_a_line_the_least_turn_is_taken() -> None:
    frame = made(np.outer(np.linspace(0.0, 0.1, 4), [0.0, 0.6, 0.8]))
    about = np.cross([0.0, 0.6, 0.8], [1.0, 0.0, 0.0])
    turns = Rotation.from_rotvec(
        np.linspace(-2.5, 2.5, 11)[:, None] * about / np.linalg.norm(about)
    ).as_matrix()
    assert np.abs(turns_of(frame, np.einsum("tij,cj->tci", turns, frame.shape)) - turns).max() < 1e-10


def test_points_in_one_place_have_no_frame() -> None:
    assert grip_frame(np.zeros((3, 3)), GRAVITY, DT_S) is None
    assert grip_frame(np.zeros((1, 3)), GRAVITY, DT_S) is None


def test_a_body_in_free_fall_moves_steadily_in_the_frame() -> None:
    """What the equivalence of gravity and acceleration says: in the frame there is none."""
    frame, ticks = made(SHAPES["in space"]), np.arange(-3.0, 2.0)
    falling = (
        [0.1, 0.2, 0.3] + ticks[:, None] * [0.01, 0.0, 0.02] + 0.5 * GRAVITY * (DT_S * ticks[:, None]) ** 2
    )
    places = torch.as_tensor(falling[:, None, None])
    controls = torch.as_tensor(frame.shape[:, None] + 0.5)
    window = torch.cat([places[:4], controls.expand(4, -1, -1, -1)], dim=1)
    turn, local, _ = enter(frame, window, controls)
    moves = local[1:, 0, 0] - local[:-1, 0, 0]
    assert (moves - moves[0]).abs().max() < 1e-12
    ahead = leave(frame, turn, (local[-1, :1] + moves[-1]))
    assert (ahead[0, 0] - places[4, 0, 0]).abs().max() < 1e-12


def moving(prior: InertialPrior | None = None) -> WorldModel:
    """An untrained network in the grip's frame that moves the body."""
    torch.manual_seed(1)
    model = WorldModel(SMALL, graph(framed=True), None, prior)
    with torch.no_grad():
        model.skip.weight.normal_(0.0, 0.01)
        model.decoder.out.weight.normal_(0.0, 0.01)
    return model.double()


def test_turning_the_world_about_the_vertical_turns_the_step() -> None:
    model, spec = moving(), graph(framed=True)
    places = torch.as_tensor(read_track(spec, episode(3), SMALL.history).positions[9:13]).double()
    turn = torch.as_tensor(Rotation.from_rotvec([0.0, 0.0, 2.0]).as_matrix())
    phi, n = torch.zeros(spec.object_count, 1, 2).double(), spec.object_count

    def step(x: torch.Tensor) -> torch.Tensor:
        return model.step(x[:3, :, None], x[3, n:, None], phi)[:, 0]

    with torch.no_grad():
        assert (step(places @ turn.T) - step(places) @ turn.T).abs().max() < 1e-9
        sideways = torch.as_tensor(Rotation.from_rotvec([1.0, 0.0, 0.0]).as_matrix())
        apart = (step(places @ sideways.T) - step(places) @ sideways.T).abs().max()
    assert apart > 1e-6, "gravity does not turn with the world"


def test_turns_found_together_are_those_of_each_step() -> None:
    model, spec = moving(), graph(framed=True)
    places = torch.as_tensor(read_track(spec, turned_episode(3, 1.0), SMALL.history).positions).double()
    phi, n = torch.zeros(spec.object_count, 1, 2).double(), spec.object_count
    window, driven = places[9:12, :, None], places[12:20, n:, None]
    turns = turns_ahead(spec.frame, driven)
    assert len(turns) == len(driven)
    with torch.no_grad():
        for control_next, turn in zip(driven, turns, strict=True):
            alone = model.step(window, control_next, phi)
            assert (model.step(window, control_next, phi, turn=turn) - alone).abs().max() < 1e-12
            ahead = model.prior_ahead(window, control_next, phi)
            assert (model.prior_ahead(window, control_next, phi, turn) - ahead).abs().max() < 1e-12
    assert turns_ahead(None, driven) == [None] * len(driven)


def turned_episode(seed: int, angle: float) -> dict[str, np.ndarray]:
    """An episode of the bar in a world that is turned about the vertical."""
    arrays = episode(seed)
    turn = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix().astype(np.float32)
    return arrays | {name: arrays[name] @ turn.T for name in ("particles", "controllers")}


def test_the_prior_in_the_frame_follows_a_turned_world_where_world_axes_do_not() -> None:
    spec = graph(framed=True)
    tracks = [read_track(spec, episode(seed), SMALL.history) for seed in range(16)]
    judged = [read_track(spec, turned_episode(seed, 2.0), SMALL.history) for seed in (20, 21)]
    priors = fit_priors([t.positions.numpy() for t in tracks], [t.phi.numpy() for t in tracks], spec, SMALL)
    errors = {
        name: prior_error(prior, judged, spec_for(name, spec), SMALL.history)
        for name, prior in priors.items()
    }
    straight = [read_track(spec, episode(seed), SMALL.history) for seed in (20, 21)]
    unturned = prior_error(priors[TURNED], straight, spec, SMALL.history)
    assert errors[TURNED] == pytest.approx(unturned, rel=1e-3)
    assert errors[TURNED] < 0.1 * errors["modal"]


def test_the_frame_is_taken_unless_another_prior_is_clearly_better() -> None:
    assert choose({"modal": 1.0, TURNED: 1.02}) == TURNED
    assert choose({"modal": 1.0, TURNED: 1.2}) == "modal"
    assert choose({"chain": 1.0, "modal": 1.1, TURNED: 1.02}) == "chain"
    assert choose({"chain": 2.0, "modal": 1.0, TURNED: 0.9}) == TURNED
    assert choose({"modal": float("nan"), TURNED: 2.0}) == TURNED
    assert choose({"modal": 1.0, "chain": 0.5}) == "chain"


@pytest.mark.parametrize(("frame", "framed"), [("grip", True), ("world", False)])
def test_a_trained_model_stands_in_the_axes_that_were_asked_for(frame: str, framed: bool) -> None:
    spec = graph(framed=True)
    tracks = [read_track(spec, episode(seed), SMALL.history) for seed in range(6)]
    training = TrainingConfig(steps=3, batch_size=2, look_ahead=2, validation_every=1, frame=frame)
    result = train(tracks, spec, SMALL, training)
    assert (result.model.spec.frame is not None) == framed
    assert (result.prior == TURNED) == framed
    n, history = spec.object_count, np.zeros((SMALL.history + 1, spec.object_count, 3)) + spec.rest_vertices
    controllers = np.repeat(episode(1)["controllers"][:1].astype(float), 12, axis=0)
    controllers[4:] += np.linspace(0.0, 0.02, 8)[:, None, None]
    published = PublishedModel(
        model=result.model,
        phi=np.zeros((n, 2)),
        phi_calibrated=np.zeros((n, 2)),
        start_history=history,
        start_controllers=controllers[: SMALL.history + 1],
        start_time_s=0.0,
        skin=affine_skin(spec.rest_vertices[:3], spec.rest_vertices),
    )
    tensors, facts = published.to_tensors(), published.facts()
    assert ("graph.neighbours" in tensors) != framed, (
        "a reader that does not know of the frame finds no edges"
    )
    assert facts["frame"] == ("grip" if framed else "world")
    again = PublishedModel.from_tensors(tensors, facts)
    moved = again.rollout(controllers)
    straight = rollout(result.model, result.model.spec, history, controllers, np.zeros((n, 2)))
    assert np.abs(moved - straight).max() < 1e-6  # published in single precision
    assert np.abs(moved[-1] - moved[0]).max() > 0.01


def test_the_exported_program_steps_in_the_frame() -> None:
    model = moving(InertialPrior(graph().object_count)).float()
    given = {name: torch.as_tensor(value) for name, value in example_inputs(model).items()}
    turn = torch.as_tensor(Rotation.from_rotvec([1.0, 0.5, 0.0]).as_matrix(), dtype=torch.float32)
    given["window"], given["control_next"] = given["window"] @ turn.T, given["control_next"] @ turn.T
    program = torch.export.load(io.BytesIO(torch_program(model))).module()
    with torch.no_grad():
        expected = model.step(
            given["window"][:, :, None], given["control_next"][:, None], given["phi"][:, None]
        )
        assert (program(*given.values()) - expected[:, 0]).abs().max() < 1e-6


def test_gravity_is_that_of_the_graph() -> None:
    frame = graph(framed=True).frame
    assert frame is not None
    assert np.allclose(frame.fall, 0.5 * np.array(GRAVITY_M_S2) * DT_S**2)
    assert graph(ground_height_m=-1.0, framed=True).frame is None
    assert graph(replace(SMALL, near_edges="current"), framed=True).frame is None
