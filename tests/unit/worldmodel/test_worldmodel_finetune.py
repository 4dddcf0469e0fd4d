"""Fine-tuning Φ on a recording whose true Φ is known, and the model as published tensors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from held_bar import SMALL, graph

from physworld.worldmodel.dataset import Track, read_track
from physworld.worldmodel.errors import VersionUnreadable
from physworld.worldmodel.finetune import Recording, fine_tune
from physworld.worldmodel.model.config import FineTuneConfig, TrainingConfig
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.skinning import affine_skin
from physworld.worldmodel.published import PublishedModel
from physworld.worldmodel.rollout import rollout, unroll
from physworld.worldmodel.training import train

pytestmark = pytest.mark.slow

TRAINING = TrainingConfig(
    steps=150, batch_size=8, look_ahead=6, learning_rate=3e-3, validation_every=50, validation_fraction=0.2
)
TUNING = FineTuneConfig(steps=20, window=10, windows=3)
WRONG_PHI = 0.5


@pytest.fixture(scope="module")
def published(tracks: list[Track], episodes: list[dict[str, np.ndarray]]) -> PublishedModel:
    spec = graph()
    model = train(tracks, spec, SMALL, TRAINING).model
    start = episodes[0]["particles"][: SMALL.history + 1].astype(np.float64)
    zero = np.zeros((spec.object_count, 2))
    return PublishedModel(
        model=model,
        phi=zero + 0.1,
        phi_calibrated=zero,
        start_history=start[:, spec.particle_index],
        start_controllers=episodes[0]["controllers"][: SMALL.history + 1].astype(np.float64),
        start_time_s=0.0,
        skin=affine_skin(start[0][::4] + 1e-3, start[0][spec.particle_index]),
    )


def _recording(published: PublishedModel, controllers: np.ndarray, phi: np.ndarray) -> Recording:
    """What the model itself predicts at ``phi``, as if it had been measured at uneven times."""
    path = published.rollout(controllers, phi=phi)
    ticks = np.sort(np.random.default_rng(0).uniform(SMALL.history + 0.5, len(path) - 1.5, 30))
    left, part = np.floor(ticks).astype(int), (ticks % 1.0)[:, None, None]
    points = published.skin.apply((1.0 - part) * path[left] + part * path[left + 1])
    visible = np.ones(points.shape[:2], dtype=bool)
    visible[::7] = False
    points[::7] = 0.0
    return Recording(published.start_history, controllers, ticks, points, visible)


def test_a_wrong_property_is_mended_by_the_recording(
    published: PublishedModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    controllers = episodes[1]["controllers"].astype(np.float64)
    truth = np.zeros((published.spec.object_count, 2))
    truth[:, 0] = WRONG_PHI
    recording = _recording(published, controllers, truth)
    result = fine_tune(published.model, np.zeros_like(truth), recording, published.skin, TUNING)
    assert result.kept
    assert result.error_after_m < 0.8 * result.error_before_m


def test_a_property_that_is_right_stays_as_it_is(
    published: PublishedModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    controllers = episodes[1]["controllers"].astype(np.float64)
    truth = np.zeros((published.spec.object_count, 2))
    result = fine_tune(
        published.model, truth, _recording(published, controllers, truth), published.skin, TUNING
    )
    assert result.error_after_m <= result.error_before_m
    assert result.kept or np.array_equal(result.phi, truth)


def test_weights_are_frozen_and_given_back_trainable(
    published: PublishedModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    before = {name: value.clone() for name, value in published.model.state_dict().items()}
    controllers = episodes[1]["controllers"].astype(np.float64)
    phi = np.full((published.spec.object_count, 2), 0.1)
    fine_tune(published.model, 0.0 * phi, _recording(published, controllers, phi), published.skin, TUNING)
    assert all(torch.equal(before[name], value) for name, value in published.model.state_dict().items())
    assert all(parameter.requires_grad for parameter in published.model.parameters())


def test_no_steps_leave_the_calibrated_properties(
    published: PublishedModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    controllers = episodes[1]["controllers"].astype(np.float64)
    phi = np.full((published.spec.object_count, 2), 0.3)
    recording = _recording(published, controllers, 0.0 * phi)
    result = fine_tune(published.model, phi, recording, published.skin, dataclasses.replace(TUNING, steps=0))
    assert not result.kept
    assert result.phi == pytest.approx(phi)


def test_what_is_stored_of_invisible_points_changes_nothing(
    published: PublishedModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    controllers = episodes[1]["controllers"].astype(np.float64)
    phi = np.full((published.spec.object_count, 2), 0.1)
    recording = _recording(published, controllers, phi)
    elsewhere = recording.points + np.where(recording.visible, 0.0, 5.0)[..., None]
    other = dataclasses.replace(recording, points=elsewhere)
    found = [fine_tune(published.model, 0.0 * phi, r, published.skin, TUNING) for r in (recording, other)]
    np.testing.assert_array_equal(found[0].phi, found[1].phi)


def test_without_a_training_frame_after_the_history_nothing_is_tuned(
    published: PublishedModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    phi = np.full((published.spec.object_count, 2), 0.1)
    recording = _recording(published, episodes[1]["controllers"].astype(np.float64), phi)
    none = {name: getattr(recording, name)[:0] for name in ("ticks", "points", "visible")}
    found = fine_tune(published.model, phi, dataclasses.replace(recording, **none), published.skin, TUNING)
    assert (found.kept, found.steps) == (False, 0)
    np.testing.assert_array_equal(found.phi, phi)


def test_published_tensors_hold_everything(
    published: PublishedModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    again = PublishedModel.from_tensors(published.to_tensors(), published.facts())
    controllers = episodes[2]["controllers"].astype(np.float64)
    assert again.rollout(controllers) == pytest.approx(published.rollout(controllers), abs=1e-6)
    assert again.skin.index.tolist() == published.skin.index.tolist()
    history = episodes[2]["particles"][: SMALL.history + 1, published.spec.particle_index].astype(np.float64)
    direct = rollout(published.model, published.spec, history, controllers, published.phi)
    assert again.rollout(controllers, history=history) == pytest.approx(direct, abs=1e-6)


@pytest.mark.parametrize(
    "name", ["graph.neighbours", "graph.rest_relative", "graph.edge_kind", "particle.index"]
)
def test_a_graph_of_other_sizes_is_refused(published: PublishedModel, name: str) -> None:
    tensors = published.to_tensors()
    short = np.ascontiguousarray(np.delete(tensors[name], -1, axis=min(1, tensors[name].ndim - 1)))
    with pytest.raises(VersionUnreadable, match="not"):
        PublishedModel.from_tensors(tensors | {name: short}, published.facts())


def test_weights_that_are_not_a_number_are_refused(published: PublishedModel) -> None:
    tensors = published.to_tensors()
    broken = tensors["encoder.in.weight"].copy()
    broken[0, 1] = np.nan
    with pytest.raises(
        VersionUnreadable, match=f"encoder.in.weight with 1 of {broken.size} values not a number"
    ):
        PublishedModel.from_tensors(tensors | {"encoder.in.weight": broken}, published.facts())


@pytest.mark.parametrize(
    ("name", "value"),
    [("graph.neighbours", -1), ("graph.neighbours", 99), ("skin.index", -1), ("control.index", -1)],
)
def test_an_index_beyond_the_graph_is_refused(published: PublishedModel, name: str, value: int) -> None:
    tensors = published.to_tensors()
    tensors[name] = tensors[name].copy()
    tensors[name].flat[0] = value
    with pytest.raises(VersionUnreadable, match=f"{name} {value}"):
        PublishedModel.from_tensors(tensors, published.facts())


@pytest.fixture(scope="module")
def with_strength(episodes: list[dict[str, np.ndarray]]) -> WorldModel:
    """The bar whose stiffness comes as the strength of an effect, in units of 0.5, and not as a property."""
    spec = graph()
    seen = [
        read_track(
            spec,
            arrays | {"properties": np.zeros_like(arrays["properties"])},
            SMALL.history,
            np.array([arrays["properties"][0, 0] / 0.5, 0.0]),
        )
        for arrays in episodes
    ]
    return train(seen, spec, SMALL, dataclasses.replace(TRAINING, steps=60)).model


def test_a_model_at_fixed_strengths_is_the_same_function(
    with_strength: WorldModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    spec, frames = with_strength.spec, SMALL.history + 1
    track = read_track(spec, episodes[3], SMALL.history, np.array([0.8, -0.3]))
    batch = track.positions[:, :, None]
    whole = unroll(
        with_strength, batch[:frames, : spec.object_count], batch[:, spec.object_count :], track.phi[:, None]
    )
    fixed = with_strength.at_strengths(torch.tensor([0.8, -0.3]))
    plain = unroll(
        fixed, batch[:frames, : spec.object_count], batch[:, spec.object_count :], track.phi[:, None, :2]
    )
    assert torch.allclose(whole, plain, atol=2e-5)
    other = with_strength.at_strengths(torch.tensor([-0.8, -0.3]))
    moved = unroll(
        other, batch[:frames, : spec.object_count], batch[:, spec.object_count :], track.phi[:, None, :2]
    )
    assert float((moved - plain).abs().max()) > 1e-4, "the strength does nothing"
    assert with_strength.strength_count == 2 and fixed.strength_count == 0


def test_a_strength_moves_towards_the_recording_and_stays_in_its_interval(
    with_strength: WorldModel, published: PublishedModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    controllers = episodes[1]["controllers"].astype(np.float64)
    zero = np.zeros((published.spec.object_count, 2))
    truth = dataclasses.replace(
        published, model=with_strength.at_strengths(torch.tensor([1.0, 0.0])), phi=zero
    )
    recording = _recording(truth, controllers, zero)
    tuning = dataclasses.replace(TUNING, steps=30, learning_rate=0.2)
    wide = fine_tune(
        with_strength, zero, recording, published.skin, tuning, bounds=np.array([[-2.0, 2.0], [-2.0, 2.0]])
    )
    assert wide.kept and wide.error_after_m < 0.8 * wide.error_before_m
    assert 0.2 < wide.strengths[0] <= 2.0
    narrow = fine_tune(
        with_strength, zero, recording, published.skin, tuning, bounds=np.array([[-0.1, 0.1], [0.0, 0.0]])
    )
    assert narrow.strengths[0] == pytest.approx(0.1) and narrow.strengths[1] == 0.0
    with pytest.raises(ValueError, match="takes 2 strengths"):
        fine_tune(with_strength, zero, recording, published.skin, tuning)
