"""Learning: better than doing nothing, the same at the same seed, resumable, and it says when it cannot."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from held_bar import SMALL, graph

from physworld.worldmodel import training_run
from physworld.worldmodel.dataset import Track, WindowSampler, read_track, split_tracks
from physworld.worldmodel.errors import (
    CheckpointMismatch,
    DatasetUnusable,
    NetworkMismatch,
    TrainingCancelled,
    TrainingDiverged,
)
from physworld.worldmodel.model.config import TrainingConfig
from physworld.worldmodel.model.features import Normalisation
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.properties import PROPERTIES, PhiColumn
from physworld.worldmodel.rollout import rollout
from physworld.worldmodel.training import train

pytestmark = pytest.mark.slow

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


def test_a_training_goes_on_from_another_models_network(tracks: list[Track]) -> None:
    first = train(tracks, graph(), SMALL, LEARNING)
    again = train(tracks, graph(), SMALL, SHORT, start=first.model)
    (_, prior), (_, begun), *_ = again.validation
    assert prior == pytest.approx(first.prior_error_m, rel=1e-6)
    assert begun == pytest.approx(first.best_error_m, rel=1e-5)
    assert again.best_error_m <= begun < prior


def test_a_network_of_other_sizes_is_no_start(tracks: list[Track]) -> None:
    other = WorldModel(dataclasses.replace(SMALL, hidden=8), graph())
    with pytest.raises(NetworkMismatch, match=r"\(16, 3, 2\); the other has \(8, 3, 2\)"):
        train(tracks, graph(), SMALL, SHORT, start=other)


def test_what_the_other_network_did_not_know_is_not_heard_at_first(tracks: list[Track]) -> None:
    known = train(tracks, graph(), SMALL, LEARNING).model
    column = PhiColumn("drag.rate", "1/s", logarithmic=False, shared=True)
    more = WorldModel(
        SMALL,
        graph(ground_height_m=-1.0),
        Normalisation(properties=(1.0, 1.0, 1.0)),
        None,
        (*PROPERTIES, column),
    )
    more.take(known)
    more.norm.load_state_dict(known.norm.state_dict() | {"properties": torch.ones(3)})
    known.norm.properties.fill_(1.0)
    h = SMALL.history
    window, ahead = tracks[0].positions[: h + 1, :, None], tracks[0].positions[h + 1, :, None]
    phi = tracks[0].phi[:, None]
    shared = torch.full((len(phi), 1, 1), 0.7)
    told = more(window, ahead, torch.cat([phi, shared], dim=-1))
    torch.testing.assert_close(told, known(window, ahead, phi))
    with pytest.raises(NetworkMismatch, match=r"hears drag\.rate, the height above a ground"):
        known.take(more)


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


def test_a_training_that_diverges_late_returns_the_best_network_before(
    tracks: list[Track], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = dataclasses.replace(LEARNING, validation_every=5)
    draw, drawn = WindowSampler.draw, []

    def from_step_30(self, frames, count, generator):
        batch = draw(self, frames, count, generator)
        drawn.append(0)
        return dataclasses.replace(batch, phi=batch.phi * float("nan")) if len(drawn) > 30 else batch

    monkeypatch.setattr(WindowSampler, "draw", from_step_30)
    found = train(tracks, graph(), SMALL, settings)
    assert found.diverged_at == 30
    assert 0 < found.best_step <= 30
    assert found.best_error_m == min(error for _, error in found.validation) < found.prior_error_m
    _, held_out = split_tracks(tracks, settings.validation_fraction, settings.seed)
    assert training_run.open_loop_error(found.model, held_out) == pytest.approx(found.best_error_m, rel=1e-6)


def test_a_step_whose_gradient_explodes_is_left_out(
    tracks: list[Track], monkeypatch: pytest.MonkeyPatch
) -> None:
    draw, drawn = WindowSampler.draw, []

    def now_and_then(self, frames, count, generator):
        batch = draw(self, frames, count, generator)
        drawn.append(0)
        return dataclasses.replace(batch, phi=batch.phi * float("nan")) if len(drawn) in (1, 6, 7) else batch

    undisturbed = train(tracks, graph(), SMALL, SHORT)
    monkeypatch.setattr(WindowSampler, "draw", now_and_then)
    losses: list[float] = []
    found = train(tracks, graph(), SMALL, SHORT, progress=lambda step, steps, loss: losses.append(loss))
    assert (undisturbed.steps_left_out, found.steps_left_out, found.steps) == (0, 3, 12)
    assert found.diverged_at is None
    assert np.isfinite(losses).all()
    assert losses[0] == 1.0
    assert losses[6] == losses[4]
    assert torch.isfinite(_weights(found.model)).all()


def test_only_what_is_far_from_usual_explodes() -> None:
    run = training_run.begin(WorldModel(SMALL, graph()), Normalisation(), "none", SHORT)
    used = [training_run.usable(run, 0.5, norm) for norm in (2.0, 3.0, 40.0, 1e9, float("inf"), 5.0)]
    assert used == [True, True, True, False, False, True]
    assert (run.left_out, run.in_a_row) == (2, 0)
    for _ in range(training_run.MOST_LEFT_OUT - 1):  # a training that has become another one is not given up
        if training_run.usable(run, 0.5, 2000.0):
            break
    else:
        pytest.fail("a gradient that stays larger was never used")


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


def test_a_training_that_stops_improving_ends_with_its_best_weights(tracks: list[Track]) -> None:
    """A rate of zero: nothing is better than the first validation."""
    hopeless = dataclasses.replace(SHORT, steps=200, learning_rate=0.0, validation_every=4, patience=3)
    result = train(tracks, graph(), SMALL, hopeless)
    assert (result.steps, result.best_step) == (12, 0)
    assert [step for step, _ in result.validation] == [0, 4, 8, 12]
    assert result.best_error_m == result.prior_error_m
    patient = train(tracks, graph(), SMALL, dataclasses.replace(hopeless, steps=24, patience=0))
    assert patient.steps == 24


def test_patience_survives_a_kill(tracks: list[Track]) -> None:
    settings = dataclasses.replace(SHORT, steps=60, learning_rate=0.0, patience=2, checkpoint_every=4)
    saved: list[bytes] = []
    whole = train(tracks, graph(), SMALL, settings, save_checkpoint=saved.append)
    for checkpoint in saved:
        resumed = train(tracks, graph(), SMALL, settings, checkpoint=checkpoint)
        assert (resumed.steps, resumed.validation) == (whole.steps, whole.validation)
        assert torch.equal(_weights(whole.model), _weights(resumed.model))


STREAMED = dataclasses.replace(SHORT, steps=20, start_share=0.5)


def test_episodes_that_arrive_late_change_nothing(tracks: list[Track]) -> None:
    """The order in which they are asked for is that of their index, and early arrival is no advantage."""
    whole = train(tracks, graph(), SMALL, STREAMED)
    asked: list[int] = []
    steps: list[int] = []

    def later(index: int) -> Track:
        asked.append(index)
        return tracks[index]

    streamed = train(
        tracks[:8],
        graph(),
        SMALL,
        STREAMED,
        total=len(tracks),
        later=later,
        progress=lambda step, steps_, loss: steps.append(len(asked)),
    )
    assert torch.equal(_weights(whole.model), _weights(streamed.model))
    assert whole.validation == streamed.validation
    assert asked == list(range(8, 16))
    assert steps[0] == 0 and 0 < steps[5] < 8 and steps[10] == 8, "some join at once or never"
    assert streamed.episodes == 16


def test_a_streamed_training_resumes_with_the_same_weights(tracks: list[Track]) -> None:
    saved: list[bytes] = []
    whole = train(tracks, graph(), SMALL, STREAMED, save_checkpoint=saved.append)
    for checkpoint in saved[:2]:
        resumed = train(
            tracks[:8],
            graph(),
            SMALL,
            STREAMED,
            total=len(tracks),
            later=tracks.__getitem__,
            checkpoint=checkpoint,
        )
        assert torch.equal(_weights(whole.model), _weights(resumed.model))


def test_the_validation_episodes_are_fixed_by_the_first_share(tracks: list[Track]) -> None:
    """What comes later is never validated on, so the errors of two steps are of the same episodes."""
    half = train(tracks[:8], graph(), SMALL, dataclasses.replace(SHORT, steps=4))
    streamed = train(tracks, graph(), SMALL, dataclasses.replace(STREAMED, steps=4))
    assert half.validation[0] == streamed.validation[0]


def test_too_few_episodes_to_begin_with_are_refused(tracks: list[Track]) -> None:
    with pytest.raises(DatasetUnusable, match="3 of 16 episodes are here; the training begins with 8"):
        train(tracks[:3], graph(), SMALL, STREAMED, total=16, later=tracks.__getitem__)
    with pytest.raises(ValueError, match="start share 0"):
        dataclasses.replace(SHORT, start_share=0.0)
