"""The chain prior: against a rope of point masses, against closed forms, and one form of it against another."""

from __future__ import annotations

import io
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import onnxruntime
import pytest
import torch
from hanging_rope import LENGTH_M, SMALL, episode, graph
from held_bar import graph as bar_graph
from physworld_client.network import Network
from scipy.spatial.transform import Rotation

from physworld.worldmodel import PublishedModel, affine_skin
from physworld.worldmodel.dataset import Track, read_track
from physworld.worldmodel.errors import VersionUnreadable
from physworld.worldmodel.export import edge_list, onnx_program, torch_program
from physworld.worldmodel.model.config import TrainingConfig
from physworld.worldmodel.model.features import Normalisation
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.native.chain_native import ChainRoller
from physworld.worldmodel.native.engine import RolloutEngine
from physworld.worldmodel.priors.chain import ChainPhysics, ChainPrior, chain_of, straight
from physworld.worldmodel.priors.chain_fit import fit_chain
from physworld.worldmodel.priors.chain_layout import Held, arc_lengths, grip_frames, held_vertices, lay_out
from physworld.worldmodel.priors.chain_step import ChainStep
from physworld.worldmodel.priors.choose import fit_priors, prior_error
from physworld.worldmodel.rollout import unroll
from physworld.worldmodel.training import train

pytestmark = pytest.mark.slow

FOLLOWED = 0.04  # mean distance over an episode, as a share of the length; this rope falls and whips
AGREEMENT_M = 2e-5  # single precision over a tick of some hundred substeps
ROUND_OFF_M = 1e-6
FIRST_ROOT = 2.404826  # of the Bessel function J0: the hanging chain swings at that times sqrt(g / L) / 2


@cache
def rope(markers: int) -> tuple[list[Track], list[Track]]:
    """Episodes to learn from and to judge by."""
    spec = graph(markers)
    every = [read_track(spec, episode(seed, markers=markers), SMALL.history) for seed in range(12)]
    return every[:9], every[9:]


@cache
def fitted(markers: int) -> ChainPrior:
    learn, _ = rope(markers)
    found = fit_chain(
        [t.positions.numpy() for t in learn], [t.phi.numpy() for t in learn], graph(markers), SMALL.history
    )
    assert found is not None
    return found


def network(markers: int) -> WorldModel:
    """An untrained network that moves the rope beside its chain."""
    torch.manual_seed(4)
    scales = dict.fromkeys(("relative", "strain", "stretch"), (0.01, 0.02, 0.03))
    model = WorldModel(
        SMALL, graph(markers), Normalisation(velocity=2e-2, change=1e-3, **scales), fitted(markers)
    )
    with torch.no_grad():
        model.skip.weight.normal_(0.0, 0.02)
        model.decoder.out.weight.normal_(0.0, 0.1)
    return model


@pytest.mark.parametrize("markers", [2, 3])
def test_the_chain_follows_a_rope_that_it_has_not_seen(markers: int) -> None:
    learn, judge = rope(markers)
    spec = graph(markers)
    positions, phis = [t.positions.numpy() for t in learn], [t.phi.numpy() for t in learn]
    modal = fit_priors(positions, phis, spec, SMALL, "modal")["modal"]
    error = prior_error(fitted(markers), judge, spec, SMALL.history)
    assert error < FOLLOWED * LENGTH_M
    assert error < 0.3 * prior_error(modal, judge, spec, SMALL.history)


def test_the_chain_answers_to_the_properties_of_an_episode() -> None:
    _, judge = rope(2)
    spec = graph(2)
    known = prior_error(fitted(2), judge, spec, SMALL.history)
    turned = [Track(t.positions, -t.phi) for t in judge]
    assert known < 0.9 * prior_error(fitted(2), turned, spec, SMALL.history)


def test_a_body_that_is_no_line_gets_no_chain() -> None:
    assert arc_lengths(bar_graph()) is None


@pytest.mark.parametrize("swing", [0.02, 0.3])
def test_a_limp_chain_swings_at_the_closed_form_s_rate_and_goes_on(swing: float) -> None:
    """Bernoulli's hanging chain, first mode; the larger swing only has to go on as it began."""
    prior, offsets = _pendulum()
    frames = 600
    shape = _bessel_mode(prior)
    start = np.zeros((1, 3, len(shape), 3), dtype=np.float32)
    order = np.argsort(-offsets)  # from the top; every segment keeps its length
    aside, length = np.diff(swing * shape[order]), np.diff(-offsets[order])
    start[..., order, 0] = swing * shape[order]
    start[..., order[1:], 2] = -np.cumsum(np.sqrt(length**2 - aside**2))
    driven = np.zeros((1, frames, 1, 3), dtype=np.float32)
    path = ChainRoller(prior, 2).run(start, driven, np.zeros((1, len(shape), 2)))[0]
    tip = path[:, int(np.argmin(offsets)), 0]
    assert np.abs(tip[-150:]).max() > 0.85 * np.abs(tip[:150]).max()
    assert np.abs(tip[-150:]).max() < 1.1 * np.abs(tip[:150]).max()
    if swing < 0.1:
        rises = np.flatnonzero((tip[:-1] < 0.0) & (tip[1:] >= 0.0))
        period = (rises[-1] - rises[0]) / (len(rises) - 1) / 30.0
        expected = 4.0 * np.pi / FIRST_ROOT * np.sqrt(1.0 / 9.81)
        assert period == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("coils", [0.0, 8.0])
@pytest.mark.parametrize("markers", [2, 3])
def test_the_native_flow_is_the_plain_one_and_so_are_its_gradients(markers: int, coils: float) -> None:
    prior, n = fitted(markers), graph(markers).object_count
    natural = coils * np.random.default_rng(7).normal(size=prior.natural.shape)
    step = ChainStep(replace(prior, natural=natural), SMALL.history)
    tracks = rope(markers)[1]
    window = torch.stack([t.positions[6:9] for t in tracks], dim=2)
    following = torch.stack([t.positions[9, n:] for t in tracks], dim=1)
    phi = torch.stack([t.phi for t in tracks], dim=1)
    found = []
    for flow in (step.native, step.flow):
        step._flow = lambda *start, f=flow: f(*start)  # type: ignore[method-assign]
        inputs = [window.clone().requires_grad_(), phi.clone().requires_grad_()]
        ahead = step(inputs[0], following, inputs[1])
        slopes = torch.linspace(-1.0, 1.0, ahead.numel()).view_as(ahead)
        by_window, by_phi = torch.autograd.grad((ahead * slopes).sum(), inputs)
        found.append((ahead.detach(), by_window[:, :n], by_phi))
    for native, plain in zip(*found, strict=True):
        assert torch.allclose(native, plain, rtol=1e-3, atol=1e-4 * float(plain.abs().max()))
    assert float(found[0][2].abs().max()) > 0.0


@pytest.mark.parametrize("roll", [0.0, 0.5 * np.pi])
def test_a_coiled_chain_without_gravity_rests_as_the_arc_of_its_curvature_and_turns_with_its_grip(
    roll: float,
) -> None:
    """An elastica without load keeps its natural curvature everywhere; its plane is fixed in the grip."""
    prior, spec, curvature = _weightless(), graph(3), 2.5
    natural = np.zeros_like(prior.natural)
    natural[:, 0] = curvature
    prior = replace(prior, natural=natural)
    n = spec.object_count
    turn = Rotation.from_rotvec([roll, 0.0, 0.0]).as_matrix()
    rest, control = spec.rest_vertices @ turn.T, rope(3)[1][0].positions[0, n:].double().numpy() @ turn.T
    begin = np.repeat(rest[None, None], SMALL.history + 1, axis=1).astype(np.float32)
    driven = np.repeat(control[None, None], 400, axis=1).astype(np.float32)
    path = ChainRoller(prior, SMALL.history).run(begin, driven, np.zeros((1, n, 2)))[0]
    nodes = (prior.read @ path[-1, :n] + prior.hold @ _driven_places(prior, driven[0, -1])).astype(np.float64)
    bent = np.linalg.norm(prior.curve @ nodes, axis=1)[1:-1]
    assert bent == pytest.approx(curvature, rel=0.05)
    off_plane = np.linalg.svd(nodes - nodes.mean(axis=0))
    assert off_plane[1][2] < 0.01 * off_plane[1][0]
    straight_up = off_plane[2][2] @ turn @ np.array(_normal_of_the_arc(prior))
    assert abs(straight_up) > 0.99


def test_a_fit_finds_the_coil_of_a_chain() -> None:
    spec, n = graph(3), graph(3).object_count
    natural = np.stack(
        [4.0 * np.ones(len(fitted(3).bend)), np.linspace(-3.0, 3.0, len(fitted(3).bend))], axis=1
    )
    coiled = replace(fitted(3), natural=natural)
    tracks = [t for part in rope(3) for t in part]
    start = np.stack([t.positions[: SMALL.history + 1, :n].numpy() for t in tracks])
    driven = np.stack([t.positions[:, n:].numpy() for t in tracks])
    phis = [t.phi.numpy() for t in tracks]
    paths = [*ChainRoller(coiled, SMALL.history).run(start, driven, np.stack(phis))]
    found = fit_chain(paths, phis, spec, SMALL.history)
    assert found is not None and np.any(found.natural)
    judged = [Track(torch.as_tensor(p), t.phi) for p, t in zip(paths[-3:], tracks[-3:], strict=True)]
    without = replace(found, natural=np.zeros_like(found.natural))
    error = prior_error(found, judged, spec, SMALL.history)
    assert error < 0.3 * prior_error(without, judged, spec, SMALL.history)
    assert found.natural[2:-2, 0].mean() == pytest.approx(4.0, rel=0.25)


def test_a_chain_of_an_earlier_version_is_straight() -> None:
    model, track = network(3), rope(3)[1][0]
    whole = _published(model, track)
    held = whole.to_tensors()
    older = {k: v for k, v in held.items() if k.removeprefix("prior.") not in straight(3)}
    assert len(older) == len(held) - 5
    again = PublishedModel.from_tensors(older, whole.facts()).model
    n = graph(3).object_count
    inputs = track.positions[4:7, :, None], track.positions[7, n:, None], track.phi[:, None]
    plain = replace(fitted(3), natural=np.zeros_like(fitted(3).natural))
    with torch.no_grad():
        expected = ChainStep(plain, SMALL.history)(*inputs)
        assert torch.allclose(again.prior(*inputs), expected, atol=ROUND_OFF_M)


def test_a_coiled_version_is_read_back_and_not_by_readers_of_straight_ones() -> None:
    prior, track, n = fitted(3), rope(3)[1][0], graph(3).object_count
    natural = 6.0 * np.random.default_rng(7).normal(size=prior.natural.shape)
    model = WorldModel(SMALL, graph(3), Normalisation(), replace(prior, natural=natural.astype(np.float32)))
    whole = _published(model, track)
    tensors = whole.to_tensors()
    assert "prior.curve" not in tensors
    window, following = track.positions[4:7], track.positions[7, n:]
    with torch.no_grad():
        expected = model.step(window[:, :, None], following[:, None], track.phi[:, None])[:, 0].numpy()
        again = PublishedModel.from_tensors(tensors, whole.facts()).model
        read = again.step(window[:, :, None], following[:, None], track.phi[:, None])[:, 0].numpy()
    assert np.abs(read - expected).max() < ROUND_OFF_M
    client = Network(tensors, n).step(window.double().numpy(), following.double().numpy(), track.phi.numpy())
    assert np.abs(client - expected).max() < AGREEMENT_M


def test_ends_that_a_chain_does_not_have_are_refused() -> None:
    with pytest.raises(ValueError, match="segments and 1 grips"):
        replace(fitted(3), carry=np.array([[0, 0], [0, 1]]))


@pytest.mark.parametrize("markers", [2, 3])
@pytest.mark.parametrize("corrected", [False, True])
def test_the_engine_rolls_the_chain_out_as_torch_does(markers: int, corrected: bool) -> None:
    model = network(markers)
    if not corrected:
        model = WorldModel(SMALL, graph(markers), None, fitted(markers))
    track, n, frames = rope(markers)[1][0], graph(markers).object_count, 12
    start, driven = track.positions[:3, :n], track.positions[:frames, n:]
    expected = unroll(model, start[:, :, None], driven[:, :, None], track.phi[:, None])[:, :, 0].numpy()
    found = RolloutEngine(model).run(start.numpy(), driven.numpy(), track.phi.double().numpy())
    assert np.abs(found - expected).max() < AGREEMENT_M


def test_a_published_rope_is_read_back_and_exported() -> None:
    model, track, n = network(2), rope(2)[1][0], graph(2).object_count
    held = _published(model, track).to_tensors()
    facts = _published(model, track).facts()
    window, following = track.positions[4:7], track.positions[7, n:]
    with torch.no_grad():
        expected = model.step(window[:, :, None], following[:, None], track.phi[:, None])[:, 0].numpy()
    again = PublishedModel.from_tensors(held, facts).model
    with torch.no_grad():
        read = again.step(window[:, :, None], following[:, None], track.phi[:, None])[:, 0].numpy()
    assert np.abs(read - expected).max() < ROUND_OFF_M  # vector code rounds by where an array lies in memory
    client = Network(held, n).step(window.double().numpy(), following.double().numpy(), track.phi.numpy())
    assert np.abs(client - expected).max() < AGREEMENT_M
    inputs = {"window": window, "control_next": following, "phi": track.phi}
    inputs |= {name: torch.as_tensor(value) for name, value in edge_list(model.spec).items()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's own container
        program = torch.export.load(io.BytesIO(torch_program(model))).module()
    assert np.abs(program(*inputs.values()).detach().numpy() - expected).max() < AGREEMENT_M
    session = onnxruntime.InferenceSession(onnx_program(model), providers=["CPUExecutionProvider"])
    (onnx,) = session.run(None, {name: value.numpy() for name, value in inputs.items()})
    assert np.abs(onnx - expected).max() < AGREEMENT_M


def test_a_published_chain_one_short_anywhere_is_refused() -> None:
    whole = _published(network(3), rope(3)[1][0])
    tensors, facts = whole.to_tensors(), whole.facts()
    chain = [name for name in tensors if name.startswith("prior.")]
    for name in chain:
        for axis in range(tensors[name].ndim):
            short = np.delete(tensors[name], -1, axis=axis)
            with pytest.raises(VersionUnreadable):
                PublishedModel.from_tensors(tensors | {name: np.ascontiguousarray(short)}, facts)
    with pytest.raises(VersionUnreadable, match="7 substeps"):
        PublishedModel.from_tensors(tensors | {"prior.substeps": np.array([7])}, facts)


def test_training_takes_the_prior_that_errs_less_and_says_so() -> None:
    learn, judge = rope(3)
    result = train([*learn, *judge], graph(3), SMALL, TrainingConfig(steps=1, batch_size=1, look_ahead=2))
    assert result.prior == "chain" and set(result.prior_errors_m) == {"chain", "modal"}
    assert result.prior_error_m == pytest.approx(result.prior_errors_m["chain"], rel=1e-3)
    assert result.heats_m == {}
    plain = train(learn, graph(3), SMALL, TrainingConfig(steps=1, batch_size=1, look_ahead=2, prior="modal"))
    assert plain.prior == "modal" and set(plain.prior_errors_m) == {"modal"}


def _pendulum() -> tuple[ChainPrior, np.ndarray]:
    """A limp chain of 1 m that hangs from one point, and the heights of its vertices [m]."""
    spec = graph(3)
    along = arc_lengths(spec)
    assert along is not None
    along = (along - along.min()) / np.ptp(along)
    top = int(np.argmin(along))
    frames = grip_frames(spec)
    one = type(frames)(np.ones((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 3)), np.ones(1))
    owner, offset = np.full(len(along), -1), np.zeros((len(along), 3))
    owner[top] = 0
    layout = lay_out(along, Held(one, owner, offset, np.array([[0.0, 0.0, 1.0]])), 16)
    physics = ChainPhysics(40.0, 1e-6, 1e-4, 0.0, np.array([0.0, 0.0, -9.81]))
    return chain_of(layout, physics, 1.0 / 30.0, np.zeros(2)), -along


def _weightless() -> ChainPrior:
    """A chain on the grip of three markers, in a liquid without gravity."""
    spec = graph(3)
    along = arc_lengths(spec)
    assert along is not None
    paths = np.concatenate([t.positions[::5].double().numpy() for t in rope(3)[0]])
    layout = lay_out(along, held_vertices(spec, paths, LENGTH_M), 16)
    return chain_of(layout, ChainPhysics(20.0, 1e-2, 2e-2, 4.0, np.zeros(3)), 1.0 / 30.0, np.zeros(2))


def _driven_places(prior: ChainPrior, controls: np.ndarray) -> np.ndarray:
    """Driven nodes (K, 3) of control vertices (C, 3)."""
    return ChainStep(prior, SMALL.history).driven(torch.as_tensor(controls)[:, None])[:, 0].numpy()


def _normal_of_the_arc(prior: ChainPrior) -> np.ndarray:
    """Normal of the plane of a positive first curvature, in the grip's frame, for a rope along x there."""
    across = prior.normal[0] - prior.normal[0] @ [1.0, 0.0, 0.0] * np.array([1.0, 0.0, 0.0])
    return np.cross([1.0, 0.0, 0.0], across / np.linalg.norm(across))


def _bessel_mode(prior: ChainPrior) -> np.ndarray:
    """J0 of the first root times the square root of the height above the free end, largest value 1."""
    from scipy.special import j0

    spec = graph(3)
    along = arc_lengths(spec)
    assert along is not None
    along = (along - along.min()) / np.ptp(along)
    return np.asarray(j0(FIRST_ROOT * np.sqrt(1.0 - along)))


def _published(model: WorldModel, track: Track) -> PublishedModel:
    n = model.spec.object_count
    vertices = track.positions[:, :n].double().numpy()
    return PublishedModel(
        model=model,
        phi=track.phi.numpy(),
        phi_calibrated=track.phi.numpy(),
        start_history=vertices[:3],
        start_controllers=track.positions[:3, n:].double().numpy(),
        start_time_s=0.0,
        skin=affine_skin(vertices[0, :5], vertices[0]),
    )
