"""Fine-tuning Φ on a recording whose true Φ is known, and the model as published tensors."""

from __future__ import annotations

import copy
import dataclasses
import json

import numpy as np
import pytest
import torch
from held_bar import SMALL, graph

from physworld.worldmodel.dataset import Track, read_track
from physworld.worldmodel.errors import VersionUnreadable
from physworld.worldmodel.finetune import Recording, fine_tune
from physworld.worldmodel.model.conditioning import Conditioning
from physworld.worldmodel.model.config import FineTuneConfig, TrainingConfig
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.properties import PROPERTIES, PhiColumn
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
OFF_M = 4e-3


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
    gain = result.error_before_m - result.error_after_m
    assert 0.0 < result.gain_ci95_m[0] < gain < result.gain_ci95_m[1]


def test_a_gain_that_may_be_chance_is_not_kept(
    published: PublishedModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    """Every property is right; the points of a frame lie off together, so that some Φ fits them a little better."""
    controllers = episodes[1]["controllers"].astype(np.float64)
    right = np.zeros((published.spec.object_count, 2))
    recording = _recording(published, controllers, right)
    shift = np.random.default_rng(0).normal(scale=OFF_M, size=(len(recording.ticks), 1, 3))
    off = dataclasses.replace(recording, points=recording.points + shift)
    result = fine_tune(published.model, right, off, published.skin, TUNING)
    assert result.error_after_m < result.error_before_m, "nothing was found that errs less"
    assert result.gain_ci95_m[0] <= 0.0 and not result.kept
    np.testing.assert_array_equal(result.phi, right)


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


STRENGTHS = tuple(
    PhiColumn(name, logarithmic=False, shared=True, calibrated=0.0, limits=(-2.0, 2.0))
    for name in ("drag.rate", "wind.speed")
)


@pytest.fixture(scope="module")
def with_strength(episodes: list[dict[str, np.ndarray]]) -> WorldModel:
    """The bar whose stiffness comes as the strength of an effect, in units of 0.5, and not as a property."""
    spec = graph()
    seen = [
        read_track(
            spec,
            arrays | {"properties": np.zeros_like(arrays["properties"])},
            SMALL.history,
            (*PROPERTIES, *STRENGTHS),
            {"drag.rate": arrays["properties"][0, 0] / 0.5, "wind.speed": 0.0},
        )
        for arrays in episodes
    ]
    settings = dataclasses.replace(TRAINING, steps=60)
    return train(seen, spec, SMALL, settings, columns=(*PROPERTIES, *STRENGTHS)).model


def at(drag: float, wind: float) -> dict[str, float]:
    """Strengths by name, in an order that is not the columns'."""
    return {"wind.speed": wind, "drag.rate": drag}


def limited(model: WorldModel, *limits: tuple[float, float]) -> WorldModel:
    """The same weights with other limits of the strengths."""
    other = copy.copy(model)
    shared = (dataclasses.replace(one, limits=ends) for one, ends in zip(STRENGTHS, limits, strict=True))
    other.columns = (*PROPERTIES, *shared)
    return other


def test_a_model_at_fixed_strengths_is_the_same_function(
    with_strength: WorldModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    spec, frames = with_strength.spec, SMALL.history + 1
    track = read_track(spec, episodes[3], SMALL.history, (*PROPERTIES, *STRENGTHS), at(0.8, -0.3))
    batch = track.positions[:, :, None]
    whole = unroll(
        with_strength, batch[:frames, : spec.object_count], batch[:, spec.object_count :], track.phi[:, None]
    )
    fixed = with_strength.at_strengths(at(0.8, -0.3))
    plain = unroll(
        fixed, batch[:frames, : spec.object_count], batch[:, spec.object_count :], track.phi[:, None, :2]
    )
    assert torch.allclose(whole, plain, atol=2e-5)
    other = with_strength.at_strengths(at(-0.8, -0.3))
    moved = unroll(
        other, batch[:frames, : spec.object_count], batch[:, spec.object_count :], track.phi[:, None, :2]
    )
    assert float((moved - plain).abs().max()) > 1e-4, "the strength does nothing"
    assert with_strength.shared_columns == STRENGTHS and fixed.columns == PROPERTIES
    with pytest.raises(ValueError, match="the model has"):
        with_strength.at_strengths({"drag.rate": 0.8})


def test_a_strength_moves_towards_the_recording_and_stays_in_its_interval(
    with_strength: WorldModel, published: PublishedModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    controllers = episodes[1]["controllers"].astype(np.float64)
    zero = np.zeros((published.spec.object_count, 2))
    truth = dataclasses.replace(published, model=with_strength.at_strengths(at(1.0, 0.0)), phi=zero)
    recording = _recording(truth, controllers, zero)
    tuning = dataclasses.replace(TUNING, steps=30, learning_rate=0.2)
    wide = fine_tune(with_strength, zero, recording, published.skin, tuning)
    assert wide.kept and wide.error_after_m < 0.8 * wide.error_before_m
    assert 0.2 < wide.strengths["drag.rate"] <= 2.0
    near = limited(with_strength, (-0.1, 0.1), (0.0, 0.0))
    narrow = fine_tune(near, zero, recording, published.skin, tuning)
    assert narrow.strengths["drag.rate"] == pytest.approx(0.1) and narrow.strengths["wind.speed"] == 0.0
    endless = limited(with_strength, (-0.1, 0.1), (0.0, 0.0))
    endless.columns = (*PROPERTIES, *(dataclasses.replace(one, limits=None) for one in STRENGTHS))
    with pytest.raises(ValueError, match=r"no limits for the model's columns drag.rate, wind.speed"):
        fine_tune(endless, zero, recording, published.skin, tuning)


def test_columns_of_phi_are_asked_for_by_name(published: PublishedModel) -> None:
    controllers = np.repeat(published.start_controllers[:1], 12, axis=0)
    controllers[6:] += 0.004
    by_place = published.phi.copy()
    by_place[:, 1] = 0.3
    named = published.rollout(controllers, phi={"density": 0.3})
    assert np.array_equal(named, published.rollout(controllers, phi=by_place))
    assert not np.array_equal(named, published.rollout(controllers))
    with pytest.raises(ValueError, match="no column 'mass'; it has stiffness, density"):
        published.rollout(controllers, phi={"mass": 0.3})


def test_a_card_tells_the_columns_of_phi_and_one_without_them_is_read(published: PublishedModel) -> None:
    tensors, facts = published.to_tensors(), published.facts()
    assert [(one["name"], one["unit"]) for one in facts["phi"]] == [
        ("stiffness", "Pa"),
        ("density", "kg/m^3"),
    ]
    spreads = [one["prior_spread"] for one in facts["phi"]]
    assert spreads == pytest.approx(tensors["norm.properties"].tolist())
    before = {name: value for name, value in facts.items() if name != "phi"}
    for told in (facts, before):
        assert PublishedModel.from_tensors(tensors, told).columns == PROPERTIES
    turned = facts | {"phi": facts["phi"][::-1]}
    with pytest.raises(VersionUnreadable, match="the columns 'density', 'stiffness'; a version has"):
        PublishedModel.from_tensors(tensors, turned)


def test_a_column_goes_from_quantities_to_values_and_back() -> None:
    friction = PhiColumn("ground.friction", "1", shared=True, calibrated=0.4)
    assert friction.column_of(0.8) == pytest.approx(np.log(2.0))
    rate = PhiColumn("drag.rate", logarithmic=False, shared=True, calibrated=3.0, half_width=0.5)
    assert rate.column_of(3.25) == pytest.approx(0.5)
    for column in (friction, rate):
        assert column.quantity_of(column.column_of(1.7)) == pytest.approx(1.7)
    with pytest.raises(ValueError, match="'stiffness' has no single calibrated value"):
        PROPERTIES[0].column_of(1e5)


def test_a_version_moves_among_the_strengths_that_its_network_learned(
    with_strength: WorldModel, published: PublishedModel, episodes: list[dict[str, np.ndarray]]
) -> None:
    """Through its files, as the same network fixed at the other strengths; nothing moves beyond what was covered."""
    covered = {"drag.rate": (-1.0, 1.5)}
    stands = Conditioning.of(with_strength, at(0.2, 0.0), covered)
    version = dataclasses.replace(published, model=with_strength.at_strengths(at(0.2, 0.0)), strengths=stands)
    read = PublishedModel.from_tensors(version.to_tensors(), json.loads(json.dumps(version.facts())))
    assert [one["name"] for one in version.facts()["strengths"]] == ["drag.rate", "wind.speed"]
    assert version.facts()["strengths"][0]["range"] == [-1.0, 1.5]
    assert read.strengths is not None and read.strengths.quantities["drag.rate"] == pytest.approx(0.2)
    controllers = episodes[1]["controllers"].astype(np.float64)
    moved = read.at_strengths({"drag.rate": 1.4}).rollout(controllers)
    direct = dataclasses.replace(published, model=with_strength.at_strengths(at(1.4, 0.0)))
    assert moved == pytest.approx(direct.rollout(controllers), abs=2e-6)
    assert np.abs(moved - read.rollout(controllers)).max() > 1e-4, "the strength does nothing"
    back = read.at_strengths({"drag.rate": 1.4}).at_strengths({"drag.rate": 0.2})
    assert back.rollout(controllers) == pytest.approx(read.rollout(controllers), abs=2e-6)
    with pytest.raises(ValueError, match=r"drag.rate is 1.6; the demonstrations covered -1 to 1.5"):
        read.at_strengths({"drag.rate": 1.6})
    with pytest.raises(ValueError, match=r"no strength 'wind'; there are drag.rate, wind.speed"):
        read.at_strengths({"wind": 0.0})
    with pytest.raises(ValueError, match="the demonstrations varied none"):
        published.at_strengths({"drag.rate": 0.1})
    cut = version.to_tensors() | {"phi.strengths.skip": np.zeros((3, 1), np.float32)}
    with pytest.raises(VersionUnreadable, match=r"phi.strengths.skip \(3, 1\)"):
        PublishedModel.from_tensors(cut, version.facts())
