"""A network without a prior: it gives the accelerations alone, in training, engine and published versions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from held_bar import SMALL, episode, graph

from physworld.worldmodel import PublishedModel, affine_skin
from physworld.worldmodel.dataset import Track, read_track
from physworld.worldmodel.export import INPUTS, StepProgram, edge_list
from physworld.worldmodel.finetune import Recording, fine_tune
from physworld.worldmodel.model.config import FineTuneConfig, TrainingConfig
from physworld.worldmodel.model.features import Normalisation
from physworld.worldmodel.model.inertia import InertialPrior, InertialStep
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.native.engine import RolloutEngine
from physworld.worldmodel.rollout import unroll
from physworld.worldmodel.training import TrainingResult, train
from physworld.worldmodel.training_run import open_loop_error

pytestmark = pytest.mark.slow

SETTINGS = TrainingConfig(
    steps=150, look_ahead=10, validation_every=50, learning_rate=1e-2, prior="none", noise_properties=0.1
)


@pytest.fixture(scope="module")
def trained(tracks: list[Track]) -> TrainingResult:
    return train(tracks, graph(), SMALL, SETTINGS)


def test_what_is_ahead_keeps_its_velocity() -> None:
    step = InertialStep(InertialPrior(3), 2)
    start, speed = torch.randn(5, 2, 3), 0.1 * torch.randn(5, 2, 3)
    window = torch.stack([start + t * speed for t in range(3)])
    ahead = step(window, start[3:], torch.zeros(3, 2, 2))
    assert torch.allclose(ahead, (start + 3 * speed)[:3], atol=1e-6)


def test_the_native_rollout_is_that_of_torch() -> None:
    spec = graph(ground_height_m=-0.1)
    torch.manual_seed(0)
    model = WorldModel(SMALL, spec, Normalisation(3e-3, 1e-3), InertialPrior(spec.object_count))
    with torch.no_grad():
        model.skip.weight.normal_(0.0, 0.1)
        model.decoder.out.weight.normal_(0.0, 0.1)
    n, frames = spec.object_count, SMALL.history + 1
    rng = np.random.default_rng(0)
    start = spec.rest_vertices + rng.normal(0.0, 1e-4, (frames, n, 3))
    controls = spec.rest_vertices[spec.neighbours[n:, 0]] + np.linspace(0.0, 0.02, 15)[:, None, None]
    phi = rng.normal(0.0, 0.1, (n, 2))
    single = [torch.as_tensor(x, dtype=torch.float32)[:, :, None] for x in (start, controls)]
    expected = unroll(model, *single, torch.as_tensor(phi, dtype=torch.float32)[:, None])[:, :, 0].numpy()
    native = RolloutEngine(model).run(start, controls, phi)
    assert np.abs(expected[-1] - expected[SMALL.history]).max() > 5e-3
    assert native == pytest.approx(expected, abs=1e-5)


def test_the_network_alone_learns(trained: TrainingResult, tracks: list[Track]) -> None:
    assert trained.prior == "none"
    assert list(trained.prior_errors_m) == ["none"]
    assert trained.best_step > 0
    assert trained.best_error_m < 0.5 * min(trained.prior_error_m, trained.static_error_m)
    fresh = [read_track(graph(), episode(seed), SMALL.history) for seed in (100, 101)]
    still = WorldModel(SMALL, graph(), Normalisation(), InertialPrior(trained.model.spec.object_count))
    assert open_loop_error(trained.model, fresh) < 0.5 * open_loop_error(still, fresh)


def test_a_version_of_it_is_published_and_exported(trained: TrainingResult, tracks: list[Track]) -> None:
    spec, frames = trained.model.spec, SMALL.history + 1
    rest = spec.rest_vertices
    controls = np.repeat(rest[spec.neighbours[spec.object_count :, 0]][None], frames, axis=0)
    model = PublishedModel(
        model=trained.model,
        phi=np.zeros((spec.object_count, 2)),
        phi_calibrated=np.zeros((spec.object_count, 2)),
        start_history=np.repeat(rest[None], frames, axis=0),
        start_controllers=controls,
        start_time_s=0.0,
        skin=affine_skin(rest, rest),
    )
    tensors = model.to_tensors()
    assert [name for name in tensors if name.startswith("prior.")] == ["prior.lags"]
    again = PublishedModel.from_tensors(tensors, model.facts())
    path = np.repeat(controls[-1:], 12, axis=0)
    path[frames:] += 0.003 * np.arange(12 - frames)[:, None, None]
    assert np.allclose(again.rollout(path), model.rollout(path), atol=1e-6)  # rest places become single
    x = tracks[0].positions
    phi = tracks[0].phi
    inputs = {"window": x[:frames], "control_next": x[frames, spec.object_count :], "phi": phi}
    inputs |= {name: torch.as_tensor(values) for name, values in edge_list(spec).items()}
    with torch.inference_mode():
        moved = StepProgram(trained.model)(*(inputs[name] for name in INPUTS))
        expected = trained.model.step(x[:frames, :, None], x[frames, spec.object_count :, None], phi[:, None])
    assert torch.allclose(moved, expected[:, 0], atol=1e-5)


def test_it_is_fine_tuned(trained: TrainingResult, tracks: list[Track]) -> None:
    """Φ of an episode is approached from zero where the network answers to it at all."""
    spec, frames = trained.model.spec, SMALL.history + 1
    n, x = spec.object_count, tracks[3].positions.numpy().astype(np.float64)
    origin = spec.rest_vertices.mean(axis=0)
    x = x + origin - x[frames - 1, :n].mean(axis=0)
    driven = np.zeros((len(x), int(spec.control_index.max()) + 1, 3))
    driven[:, spec.control_index] = x[:, n:]
    recording = Recording(
        history=x[:frames, :n],
        controllers=driven,
        ticks=np.arange(frames, len(x), dtype=float),
        points=x[frames:, :n],
        visible=np.ones((len(x) - frames, n), dtype=bool),
    )
    skin = affine_skin(spec.rest_vertices, spec.rest_vertices)
    tuned = fine_tune(trained.model, np.zeros((n, 2)), recording, skin, FineTuneConfig(steps=10))
    assert tuned.steps > 0
    assert tuned.error_after_m <= tuned.error_before_m
