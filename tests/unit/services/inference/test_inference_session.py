"""A live session without its connection."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from published_tiny import DRAG, tiny_model

from physworld.worldmodel.published import PublishedModel
from physworld_services.inference.session import HEAD, SET_BACK, ControlRefused, LiveSession

pytestmark = pytest.mark.slow


def flags(frame: bytes) -> int:
    return int(HEAD.unpack_from(frame)[3])


def test_a_client_learns_that_it_was_set_back_whichever_frames_are_left_out() -> None:
    """Frames that a slow reader never gets told nobody: the flag stays until one was sent."""
    model = tiny_model()[2]
    tensors = model.to_tensors()
    tensors["prior.weight"] = 50.0 * tensors["prior.weight"]  # grows without bound
    session = LiveSession(PublishedModel.from_tensors(tensors, model.facts()))
    still, ticks = np.zeros((4, 3)), 0
    while not flags(session.frame(1.0, 0)) & SET_BACK:
        session.tick(still)
        ticks += 1
        assert ticks < 100, "the prediction stays in the numbers"
    session.tick(still)
    later = session.frame(1.0, 0)
    assert flags(later) & SET_BACK
    session.sent(later)
    session.tick(still)
    assert not flags(session.frame(1.0, 0)) & SET_BACK


def test_a_factor_changes_the_body_from_the_next_tick_on_as_it_changes_a_rollout() -> None:
    model = tiny_model()[2]
    velocity = np.tile([0.0, 0.0, 0.3], (4, 1))

    def points(factors: dict[str, float] | None) -> np.ndarray:
        session = LiveSession(model)
        assert session.describe()["factors"] == ["stiffness", "density"]
        if factors is not None:
            session.set_factors(factors)
            session.reset()
        for _ in range(5):
            session.tick(velocity)
        return np.frombuffer(session.frame(1.0, 0), "<f4", offset=HEAD.size).reshape(-1, 3)

    plain, stiff = points(None), points({"stiffness": 4.0})
    assert np.array_equal(points({"stiffness": 1.0, "density": 1.0}), plain)
    assert np.abs(stiff - plain).max() > 1e-5
    steps = model.start_controllers[-1] + model.spec.dt_s * np.arange(1, 6)[:, None, None] * velocity
    driven = np.concatenate([model.start_controllers, steps])
    expected = model.skin.apply(model.rollout(driven, phi=model.phi + np.array([np.log(4.0), 0.0]))[-1])
    assert stiff[: len(expected)] == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ({"stiffness": 0.001}, "0.01 to 100"),
        ({"stiffness": "2"}, "not a finite number"),
        ({"stiffness": True}, "not a finite number"),
        ({"friction": 2.0}, "there are stiffness, density"),
    ],
)
def test_a_factor_that_cannot_be_meant_is_refused(factors: dict[str, Any], words: str) -> None:
    with pytest.raises(ControlRefused, match=words):
        LiveSession(tiny_model()[2]).set_factors(factors)


def test_a_strength_that_the_training_varied_changes_the_body_within_its_range() -> None:
    model = tiny_model(dragged=True)[2]
    velocity = np.tile([0.0, 0.0, 0.3], (4, 1))
    name = f"{DRAG.effect}.{DRAG.name}"

    def points(strengths: dict[str, float] | None) -> np.ndarray:
        session = LiveSession(model)
        assert session.describe()["strengths"] == [
            {"name": name, "label": "air drag linear: rate", "unit": "1/s", "value": 2.0}
            | {"low": pytest.approx(DRAG.low), "high": pytest.approx(DRAG.high)}
        ]
        if strengths is not None:
            session.set_strengths(strengths)
            session.reset()
        for _ in range(5):
            session.tick(velocity)
        return np.frombuffer(session.frame(1.0, 0), "<f4", offset=HEAD.size).reshape(-1, 3)

    plain, dragged = points(None), points({name: 3.4})
    assert points({name: 2.0}) == pytest.approx(plain, abs=1e-6)
    assert np.abs(dragged - plain).max() > 2e-6
    steps = model.start_controllers[-1] + model.spec.dt_s * np.arange(1, 6)[:, None, None] * velocity
    driven = np.concatenate([model.start_controllers, steps])
    expected = model.skin.apply(model.at_strengths({name: 3.4}).rollout(driven)[-1])
    assert dragged[: len(expected)] == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize(
    ("strengths", "words"),
    [
        ({f"{DRAG.effect}.{DRAG.name}": 4.0}, r"is 4; the demonstrations covered 0.5 to 3.5 1/s"),
        ({f"{DRAG.effect}.{DRAG.name}": None}, "not a finite number"),
        ({"wind.rate_per_s": 1.0}, "there are air_drag_linear.rate_per_s"),
    ],
)
def test_a_strength_that_was_not_covered_is_refused(strengths: dict[str, Any], words: str) -> None:
    with pytest.raises(ControlRefused, match=words):
        LiveSession(tiny_model(dragged=True)[2]).set_strengths(strengths)


def test_a_model_without_varied_strengths_offers_none() -> None:
    session = LiveSession(tiny_model()[2])
    assert session.describe()["strengths"] == []
    with pytest.raises(ControlRefused, match="the demonstrations varied none"):
        session.set_strengths({"wind.rate_per_s": 1.0})


def test_a_frame_between_two_ticks_is_of_one_moment() -> None:
    """Time, points and grips alike: grips that were ahead of the body would seem to stretch it."""
    session = LiveSession(tiny_model()[2])
    session.tick(np.tile([0.0, 0.0, 0.3], (4, 1)))
    first = session.frame(1.0, 0)
    session.tick(np.tile([0.0, 0.0, 0.3], (4, 1)))
    between, newest = session.frame(0.5, 0), session.frame(1.0, 0)
    heads = [HEAD.unpack_from(frame) for frame in (first, between, newest)]
    assert [head[0] for head in heads] == [1, 2, 2]
    assert [head[2] for head in heads] == pytest.approx([session.dt_s * tick for tick in (1.0, 1.5, 2.0)])
    places = [np.frombuffer(frame, "<f4", offset=HEAD.size) for frame in (first, between, newest)]
    assert places[1] == pytest.approx(0.5 * (places[0] + places[2]), abs=1e-7)
    assert places[2][-1] - places[0][-1] == pytest.approx(0.3 * session.dt_s, abs=1e-6)


def test_a_grip_lets_go_and_takes_hold_where_the_material_is() -> None:
    session = LiveSession(tiny_model("between two grips")[2])
    assert session.describe()["holding"] == [[0], [0, 1]]
    still, up = np.zeros((8, 3)), np.zeros((8, 3))
    up[4:, 2] = 0.3

    def far_grip() -> np.ndarray:
        return np.asarray(session.controllers[4:].mean(axis=0))

    def ticks(velocity: np.ndarray, count: int) -> np.ndarray:
        before = far_grip()
        for _ in range(count):
            session.tick(velocity)
        return far_grip() - before

    assert np.abs(ticks(still, 5)).max() == 0.0
    session.open_grips([1])
    fallen = ticks(up, 20)  # nobody leads an open grip
    assert fallen[2] < -3e-3
    session.open_grips([])
    assert ticks(still, 1) == pytest.approx(np.zeros(3), abs=1e-12)
    assert ticks(up, 5)[2] == pytest.approx(5 * 0.3 * session.dt_s)
    session.open_grips([1])
    session.reset()
    assert ticks(up, 5)[2] == pytest.approx(5 * 0.3 * session.dt_s), "a reset closes every grip"


def test_a_grip_that_closed_beyond_its_reach_does_not_jump() -> None:
    session = LiveSession(tiny_model("between two grips")[2])
    session.open_grips([1])
    for _ in range(10):
        session.tick(np.zeros((8, 3)))
    session.reach_m = 1e-3
    session.open_grips([])
    before = session.controllers.copy()
    assert before[4, 2] < session.describe()["controllers"][4][2] - session.reach_m
    down = np.tile([0.0, 0.0, -0.3], (8, 1))
    session.tick(down)
    moved = session.controllers - before
    assert moved[4:] == pytest.approx(np.zeros((4, 3)), abs=1e-12), "and goes no further"
    session.tick(-down)
    assert (session.controllers - before)[4:, 2] == pytest.approx(np.full(4, 0.3 * session.dt_s))


@pytest.mark.parametrize(
    ("grips", "words"),
    [
        ([0], r"grips \[1\] would hold; the version has models of \[0\], \[0, 1\]"),
        ([0, 1], r"grips \[\] would hold"),
        ([2], r"grips \[2\] are to open; the session has 2, from 0 on"),
        ([True], r"grips \[True\] are to open"),
        (["1"], r"grips \['1'\] are to open"),
    ],
)
def test_grips_that_no_model_is_for_stay_closed(grips: list[Any], words: str) -> None:
    with pytest.raises(ControlRefused, match=words):
        LiveSession(tiny_model("between two grips")[2]).open_grips(grips)
    with pytest.raises(ControlRefused, match=r"grips \[\] would hold; the version has models of \[0\]$"):
        LiveSession(tiny_model()[2]).open_grips([0])
