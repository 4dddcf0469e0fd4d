"""The search on problems whose answers are known, its limits, and goals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from physworld.errors import Cancelled, UnstableSimulation
from physworld.planning.goals import GoalPoints, GoalShape, GripLimits
from physworld.planning.mppi import MppiConfig, coloured_noise, search

DT = 1 / 30
LIMITS = GripLimits(
    speed_m_s=0.5,
    acceleration_m_s2=4.0,
    box_min_m=np.full((1, 3), -0.3),
    box_max_m=np.full((1, 3), 0.3),
    spread_max_m=np.full((1, 1), np.inf),
    centres_m=np.zeros((1, 3)),
)
QUICK = MppiConfig(horizon=40, samples=128, iterations=12)


def carried(displacements: np.ndarray) -> np.ndarray:
    """A body that goes where its only grip goes: one point at its centre."""
    return displacements


def pendulum(displacements: np.ndarray) -> np.ndarray:
    """A mass on a soft spring at the grip: it lags and swings, so a straight way overshoots."""
    batch, ticks = displacements.shape[:2]
    place, speed = np.zeros((batch, 1, 3)), np.zeros((batch, 1, 3))
    path = []
    for t in range(ticks):
        for _ in range(4):
            speed = speed + 0.25 * DT * (40.0 * (displacements[:, t] - place) - 0.2 * speed)
            place = place + 0.25 * DT * speed
        path.append(place)
    return np.stack(path, axis=1)


def test_a_carried_point_is_brought_to_its_goal() -> None:
    goal = GoalPoints(np.array([0]), np.array([[0.1, -0.05, 0.08]]))
    found = search(carried, goal, LIMITS, DT, QUICK, np.random.default_rng(0))
    assert found.distance_m < 0.015  # of 137 mm
    assert np.linalg.norm(found.displacements[-1, 0] - goal.places[0]) < 0.03
    assert found.costs[0] > 10 * found.costs[-1]
    assert all(b <= a for a, b in zip(found.costs, found.costs[1:], strict=False))
    assert found.samples == 1 + QUICK.samples * QUICK.iterations


def test_a_swinging_mass_is_calmed_better_than_by_the_straight_way() -> None:
    goal = GoalPoints(np.array([0]), np.array([[0.12, 0.0, 0.0]]))
    config = replace(QUICK, iterations=20)
    found = search(pendulum, goal, LIMITS, DT, config, np.random.default_rng(1))
    straight = np.clip(np.arange(1, 41) / 20, 0.0, 1.0)[:, None, None] * goal.places
    error = goal.distance(pendulum(straight[None]))[0, -config.settling :].mean()
    assert found.distance_m < 0.5 * error


def test_the_same_seed_finds_the_same_motion() -> None:
    goal = GoalPoints(np.array([0]), np.array([[0.1, 0.0, 0.0]]))
    config = replace(QUICK, iterations=2)
    first, again, other = (
        search(carried, goal, LIMITS, DT, config, np.random.default_rng(seed)).displacements
        for seed in (3, 3, 4)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_every_motion_keeps_the_limits() -> None:
    limits = GripLimits(
        speed_m_s=0.5,
        acceleration_m_s2=4.0,
        box_min_m=np.array([[-0.05, -0.3, 0.0], [-0.3, -0.3, -0.3]]),
        box_max_m=np.array([[0.3, 0.3, 0.3], [0.05, 0.3, 0.3]]),
        spread_max_m=np.array([[0.0, 0.25], [0.25, 0.0]]),
        centres_m=np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]]),
    )
    velocities = np.random.default_rng(0).normal(0.0, 1.0, (50, 40, 2, 3))
    kept = limits.kept(velocities, DT)
    places = DT * kept.cumsum(axis=1)
    assert 0.45 < np.linalg.norm(kept, axis=-1).max() <= 0.5 + 1e-9
    assert (places >= limits.box_min_m - 1e-9).all()
    assert (places <= limits.box_max_m + 1e-9).all()
    gap = np.linalg.norm(places[..., 1, :] + limits.centres_m[1] - places[..., 0, :], axis=-1)
    assert gap.max() < 0.25 + 0.02  # the boxes have the last word
    free = replace(limits, spread_max_m=np.full((2, 2), np.inf), box_min_m=np.full((2, 3), -9.0))
    free = replace(free, box_max_m=np.full((2, 3), 9.0))
    calm = free.kept(velocities, DT)
    assert np.linalg.norm(calm, axis=-1).max() <= 0.5 + 1e-9
    assert np.linalg.norm(np.diff(calm, axis=1, prepend=0.0), axis=-1).max() <= 4.0 * DT + 1e-9
    assert np.allclose(free.kept(calm, DT), calm)


def test_a_plan_of_moving_grips_keeps_their_acceleration_from_its_first_tick() -> None:
    start = np.array([[0.4, 0.0, 0.0]])
    roomy = replace(LIMITS, box_min_m=np.full((1, 3), -9.0), box_max_m=np.full((1, 3), 9.0))
    limits = replace(roomy, start_m_s=start)
    for wanted in (np.zeros((1, 40, 1, 3)), np.random.default_rng(0).normal(0.0, 1.0, (50, 40, 1, 3))):
        kept = limits.kept(wanted, DT)
        before = np.broadcast_to(start, (len(kept), 1, 1, 3))
        assert np.linalg.norm(np.diff(kept, axis=1, prepend=before), axis=-1).max() <= 4.0 * DT + 1e-9
    stopping = limits.kept(np.zeros((40, 1, 3)), DT)
    assert stopping[0, 0, 0] == pytest.approx(0.4 - 4.0 * DT)
    assert np.abs(stopping[3:]).max() < 1e-9


def test_a_search_from_moving_grips_never_jumps_to_rest() -> None:
    """Its first motion, and its answer where nothing is better, is the stop that the limits allow."""
    start = np.array([[0.4, 0.0, 0.0]])
    limits = replace(LIMITS, start_m_s=start)
    goal = GoalPoints(np.array([0]), np.zeros((1, 3)))
    found = search(carried, goal, limits, DT, replace(QUICK, iterations=2), np.random.default_rng(0))
    velocities = np.diff(found.displacements, axis=0, prepend=np.zeros((1, 1, 3))) / DT
    change = np.linalg.norm(np.diff(velocities, axis=0, prepend=start[None]), axis=-1)
    assert change.max() <= 4.0 * DT + 1e-9


def test_a_grip_that_is_pulled_along_keeps_its_speed_limit() -> None:
    limits = GripLimits(
        speed_m_s=0.5,
        acceleration_m_s2=1e3,
        box_min_m=np.full((2, 3), -9.0),
        box_max_m=np.full((2, 3), 9.0),
        spread_max_m=np.array([[0.0, 0.2], [0.2, 0.0]]),
        centres_m=np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]]),
    )
    wanted = np.zeros((30, 2, 3))
    wanted[:, 0, 1], wanted[:, 1, 0] = 0.5, 0.5  # one across the line between them, one away along it
    kept = limits.kept(wanted, DT)
    assert np.linalg.norm(kept, axis=-1).max() <= 0.5 + 1e-9
    places = DT * kept.cumsum(axis=0) + limits.centres_m
    assert np.linalg.norm(places[:, 1] - places[:, 0], axis=-1).max() <= 0.2 + 1e-4  # a pass leaves that much


def test_a_motion_that_leaves_the_numbers_is_never_chosen() -> None:
    def fragile(displacements: np.ndarray) -> np.ndarray:
        broken = np.abs(displacements).max(axis=(1, 2, 3)) > 0.05
        return np.where(broken[:, None, None, None], np.nan, displacements)

    goal = GoalPoints(np.array([0]), np.array([[0.2, 0.0, 0.0]]))
    found = search(fragile, goal, LIMITS, DT, replace(QUICK, iterations=4), np.random.default_rng(0))
    assert np.abs(found.displacements).max() <= 0.05
    assert np.isfinite(found.points).all()


@pytest.mark.parametrize("goal", [GoalPoints(np.array([0]), np.zeros((1, 3))), GoalShape(np.zeros((4, 3)))])
def test_a_model_that_leaves_the_numbers_at_rest_is_refused(goal: GoalPoints | GoalShape) -> None:
    def broken(displacements: np.ndarray) -> np.ndarray:
        points = displacements.copy()
        points[:, 29:] = np.nan
        return points

    with pytest.raises(UnstableSimulation, match="1 s after its start with grips that come to rest"):
        search(broken, goal, LIMITS, DT, QUICK, np.random.default_rng(0))


def test_a_search_can_be_stopped_and_tells_its_progress() -> None:
    goal = GoalPoints(np.array([0]), np.array([[0.1, 0.0, 0.0]]))
    told: list[tuple[int, int]] = []
    with pytest.raises(Cancelled):
        search(
            carried,
            goal,
            LIMITS,
            DT,
            QUICK,
            np.random.default_rng(0),
            progress=lambda done, total, cost: told.append((done, total)),
            cancelled=lambda: len(told) == 3,
        )
    assert told == [(1, 12), (2, 12), (3, 12)]


@pytest.mark.parametrize("colour", [0.0, 2.5])
def test_noise_has_the_colour_that_is_asked_for(colour: float) -> None:
    noise = coloured_noise(np.random.default_rng(0), (400, 64, 1, 3), colour)
    assert noise.std() == pytest.approx(1.0, abs=1e-9)
    window = np.hanning(64)[:, None, None]
    power = (np.abs(np.fft.rfft(noise * window, axis=1)) ** 2).mean(axis=(0, 2, 3))
    slope = np.polyfit(np.log(np.arange(3, 16)), np.log(power[3:16]), 1)[0]
    assert slope == pytest.approx(-colour, abs=0.3)


def test_the_distance_to_a_shape_is_the_two_way_chamfer_distance() -> None:
    rng = np.random.default_rng(0)
    body, shape = rng.normal(size=(2, 3, 40, 3)), rng.normal(size=(30, 3))
    gap = np.linalg.norm(body[..., :, None, :] - shape, axis=-1)
    expected = 0.5 * (gap.min(axis=-1).mean(axis=-1) + gap.min(axis=-2).mean(axis=-1))
    assert GoalShape(shape).distance(body) == pytest.approx(expected)
    assert GoalShape(shape).distance(shape[None])[0] == 0.0
