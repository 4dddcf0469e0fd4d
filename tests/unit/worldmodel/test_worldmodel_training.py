"""Learning: better than doing nothing, the same at the same seed, resumable, and it says when it cannot."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from held_bar import SMALL, graph

from physworld.worldmodel.config import TrainingConfig
from physworld.worldmodel.dataset import Track, WindowSampler, read_track, split_tracks
from physworld.worldmodel.errors import (
    CheckpointMismatch,
    DatasetUnusable,
    TrainingCancelled,
    TrainingDiverged,
)
from physworld.worldmodel.rollout import rollout
from physworld.worldmodel.training import train

SHORT = TrainingConfig(
    steps=12, batch_size=2, look_ahead=2, validation_every=4, checkpoint_every=4, validation_fraction=0.2
)
LEARNING = dataclasses.replace(
    SHORT, steps=60, batch_size=6, look_ahead=12, learning_rate=1e-3, validation_every=20
)


def _weights(model: torch.nn.Module) -> torch.Tensor:
    return torch.cat([parameter.detach().reshape(-1) for parameter in model.parameters()])


def test_a_short_training_beats_every_baseline_open_loop(tracks: list[Track]) -> None:
    spec = graph()
    result = train(tracks, spec, SMALL, LEARNING)
    _, held_out = split_tracks(tracks, LEARNING.validation_fraction, LEARNING.seed)
    h, n = SMALL.history, spec.object_count
    constant_velocity = []
    for track in held_out:
        x = track.positions[:, :n]
        ahead = torch.arange(1, len(x) - h)[:, None, None]
        guess = torch.cat([x[: h + 1], x[h] + ahead * (x[h] - x[h - 1])])
        constant_velocity.append(float(torch.linalg.vector_norm(guess - x, dim=-1).mean()))
    assert result.best_step > 0
    assert result.best_error_m < 0.985 * result.prior_error_m
    assert result.best_error_m < 0.5 * result.static_error_m
    assert result.best_error_m < 0.5 * np.mean(constant_velocity)


def test_the_same_seed_gives_the_same_weights_and_another_one_others(tracks: list[Track]) -> None:
    first, second = (train(tracks, graph(), SMALL, SHORT) for _ in range(2))
    other = train(tracks, graph(), SMALL, dataclasses.replace(SHORT, seed=1))
    assert torch.equal(_weights(first.model), _weights(second.model))
    assert first.validation == second.validation
    assert not torch.equal(_weights(first.model), _weights(other.model))


def test_a_resumed_training_ends_with_the_same_weights(tracks: list[Track]) -> None:
    whole = train(tracks, graph(), SMALL, SHORT)
    saved: list[bytes] = []

    def stop() -> bool:
        return bool(saved)

    with pytest.raises(TrainingCancelled, match="step 4"):
        train(tracks, graph(), SMALL, SHORT, save_checkpoint=saved.append, cancelled=stop)
    resumed = train(tracks, graph(), SMALL, SHORT, checkpoint=saved[0])
    assert torch.equal(_weights(whole.model), _weights(resumed.model))
    assert whole.validation == resumed.validation
    assert whole.best_step == resumed.best_step


def test_a_checkpoint_of_other_settings_is_refused(tracks: list[Track]) -> None:
    saved: list[bytes] = []
    train(tracks, graph(), SMALL, SHORT, save_checkpoint=saved.append)
    with pytest.raises(CheckpointMismatch):
        train(tracks, graph(), SMALL, dataclasses.replace(SHORT, batch_size=3), checkpoint=saved[0])


def test_a_loss_that_is_not_a_number_is_named_with_its_step(
    tracks: list[Track], monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = WindowSampler.draw

    def poisoned(self, frames, count, generator):
        batch = draw(self, frames, count, generator)
        return dataclasses.replace(batch, phi=batch.phi * float("nan"))

    monkeypatch.setattr(WindowSampler, "draw", poisoned)
    with pytest.raises(TrainingDiverged, match="step 0") as caught:
        train(tracks, graph(), SMALL, SHORT)
    assert caught.value.step == 0


def test_progress_tells_every_step(tracks: list[Track]) -> None:
    seen: list[tuple[int, int]] = []
    train(tracks, graph(), SMALL, SHORT, progress=lambda step, steps, loss: seen.append((step, steps)))
    assert seen == [(step, 12) for step in range(1, 13)]


def test_episodes_at_another_clock_or_of_another_body_are_refused(
    episodes: list[dict[str, np.ndarray]],
) -> None:
    spec, arrays = graph(), episodes[0]
    with pytest.raises(DatasetUnusable, match="apart"):
        read_track(spec, arrays | {"times": arrays["times"] * 1.5}, SMALL.history)
    with pytest.raises(DatasetUnusable, match="another body"):
        read_track(spec, arrays | {"particles": arrays["particles"][:, :10]}, SMALL.history)
    with pytest.raises(DatasetUnusable, match="not finite"):
        read_track(spec, arrays | {"particles": arrays["particles"] * np.float32("nan")}, SMALL.history)
    short = {name: arrays[name][:3] for name in ("times", "particles", "controllers")}
    with pytest.raises(DatasetUnusable, match="3 frames"):
        read_track(spec, arrays | short, SMALL.history)


def test_a_rollout_starts_as_told_and_moves_with_the_world(
    tracks: list[Track], episodes: list[dict[str, np.ndarray]]
) -> None:
    spec, h = graph(), SMALL.history
    model = train(tracks, spec, SMALL, SHORT).model
    arrays = episodes[0]
    start = arrays["particles"][: h + 1, spec.particle_index].astype(np.float64)
    controllers = arrays["controllers"].astype(np.float64)
    phi = arrays["properties"][spec.particle_index]
    path = rollout(model, spec, start, controllers, phi)
    assert path.shape == (len(controllers), spec.object_count, 3)
    assert path[: h + 1] == pytest.approx(start, abs=1e-6)
    shift = np.array([3.0, -2.0, 1.0])
    moved = rollout(model, spec, start + shift, controllers + shift, phi)
    assert moved - shift == pytest.approx(path, abs=1e-5)
