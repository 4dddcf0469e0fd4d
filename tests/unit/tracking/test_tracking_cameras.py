"""What several cameras follow as one: places once, grips without jumps, places that others tell."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.tracking.grips import joined
from physworld.tracking.neighbours import carried
from physworld.tracking.recording import distinct

FRAMES = 20


def grid(shift: float = 0.0) -> np.ndarray:
    """Points (T, 9, 3) [m] a centimetre apart that move along x."""
    x, y = np.meshgrid(np.arange(3) * 0.01, np.arange(3) * 0.01)
    first = np.stack([x.ravel() + shift, y.ravel(), np.zeros(9)], axis=1)
    return first + np.linspace(0, 0.1, FRAMES)[:, None, None] * [1, 0, 0]


def chosen(points: list[np.ndarray], visible: list[np.ndarray], noise: list[float]) -> tuple[list[int], int]:
    owner = np.repeat(np.arange(len(points)), [each.shape[1] for each in points])
    kept, shared = distinct(
        np.concatenate(points, axis=1), np.concatenate(visible, axis=1), owner, np.array(noise)
    )
    return kept.tolist(), shared


def test_a_place_of_two_cameras_counts_once_and_the_one_seen_longer_stays() -> None:
    seen, briefly = np.ones((FRAMES, 9), dtype=bool), np.ones((FRAMES, 9), dtype=bool)
    briefly[10:] = False
    both = [grid(), grid(0.002)]
    assert chosen(both, [seen, briefly], [1e-3, 1e-4]) == (list(range(9)), 9)
    assert chosen(both, [briefly, seen], [1e-4, 1e-3]) == (list(range(9, 18)), 9)
    # of two that are seen as long the better camera's
    assert chosen(both, [seen, seen], [1e-3, 2e-4]) == (list(range(9, 18)), 9)
    assert chosen(both, [seen, seen], [2e-4, 1e-3]) == (list(range(9)), 9)


def test_places_that_part_are_two_and_so_are_those_of_one_camera() -> None:
    seen = np.ones((FRAMES, 9), dtype=bool)
    leaving = grid(0.002)
    leaving[:, 4] += np.linspace(0, 0.1, FRAMES)[:, None] * [0, 0, 1]
    kept, shared = chosen([grid(), leaving], [seen, seen], [1e-3, 1e-3])
    assert shared == 8 and kept == [*range(9), 13]
    twins = np.concatenate([grid(), grid(0.0005)], axis=1)
    assert chosen([twins], [np.ones((FRAMES, 18), dtype=bool)], [1e-3]) == (list(range(18)), 0)


def test_points_seen_in_a_twentieth_of_the_frames_are_left_out() -> None:
    seen = np.ones((FRAMES, 9), dtype=bool)
    seen[1:, 3] = False
    kept, _ = chosen([grid()], [seen], [1e-3])
    assert kept == [0, 1, 2, 4, 5, 6, 7, 8]


def test_a_grip_does_not_jump_where_one_of_two_cameras_loses_sight() -> None:
    exact = np.linspace(0, 0.1, FRAMES)[:, None, None] * np.array([1.0, 0, 0]) + np.eye(4)[:, :3]
    one, other = exact + np.array([0, 0, 0.004]), exact - np.array([0, 0, 0.002])
    one[12:], other[:5] = np.nan, np.nan
    path = joined([one, other])
    steps = np.diff(path, axis=0) - np.diff(exact, axis=0)
    assert np.abs(steps).max() < 1e-12
    assert np.allclose(path - exact, [0, 0, 0.001])
    one[:], other[:3] = np.nan, np.nan
    assert np.isnan(joined([one, other])[:5]).all() and np.allclose(joined([one, other])[5:], other[5:])


def test_others_carry_a_point_that_a_camera_lost() -> None:
    rng = np.random.default_rng(0)
    start = rng.normal(scale=0.02, size=(40, 3))
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    now = start @ turn.T + [0.1, 0.0, 0.05] + rng.normal(scale=1e-4, size=start.shape)
    now[::9] += 0.05  # some are wrong
    at = rng.normal(scale=0.02, size=(7, 3))
    places = carried(at, start, now, 10)
    assert places is not None
    assert np.linalg.norm(places - (at @ turn.T + [0.1, 0.0, 0.05]), axis=1) == pytest.approx(0.0, abs=3e-3)
    assert carried(at, start[:4], now[:4], 10) is None
