"""Faulty sightings are found, and nothing that a body does is taken for one."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.estimation.faults import find_faults
from physworld.estimation.noise import Split

FRAMES, TRAIN, SIGMA = 60, 42, 1e-3
SPLIT = Split((1, TRAIN), (TRAIN, FRAMES), np.array([1, 20, TRAIN]))
GRID = np.stack(
    np.meshgrid(np.linspace(0.0, 0.2, 5), np.linspace(0.0, 0.1, 4), [0.0], indexing="ij"), axis=-1
)
START = GRID.reshape(-1, 3)


def recorded(seed: int = 0, moved: np.ndarray | float = 0.0, start: np.ndarray = START) -> np.ndarray:
    """What a camera sees of a body that a twin would keep at rest and that moves by (T, N, 3) or not."""
    noise = np.random.default_rng(seed).normal(0.0, SIGMA, (FRAMES, len(start), 3))
    return start + moved + noise


def found(points: np.ndarray, visible: np.ndarray | None = None, start: np.ndarray = START) -> np.ndarray:
    seen = np.ones(points.shape[:2], dtype=bool) if visible is None else visible
    tracks = np.broadcast_to(start, points.shape)
    return find_faults(points, seen, tracks, SPLIT, SIGMA).sightings


@pytest.mark.parametrize("seed", range(20))
def test_noise_is_no_fault(seed: int) -> None:
    assert not found(recorded(seed)).any()


def test_what_a_body_does_is_no_fault() -> None:
    """It rings, it is struck in the middle of the recording, one end of it is let go."""
    time, along = np.arange(FRAMES)[:, None] / 30.0, START[:, 0] / 0.2
    ringing = 0.02 * np.sin(25.0 * time) * along**2
    struck = np.where(time > 0.7, 0.02 * np.sin(20.0 * (time - 0.7)), 0.0) * along**2
    fallen = np.where(time > 0.9, 4.0 * (time - 0.9) ** 2, 0.0) * (along > 0.7)
    for shift in (ringing, struck, fallen):
        moved = np.zeros((FRAMES, len(START), 3))
        moved[..., 2] = shift
        assert not found(recorded(1, moved)).any()


def test_a_frame_that_is_off_is_left_out_and_no_other() -> None:
    points = recorded()
    points[20] += [0.03, 0.0, 0.02]
    assert np.array_equal(np.flatnonzero(found(points).any(axis=1)), [20]) and found(points)[20].all()


def test_markers_that_are_taken_for_each_other_for_a_while_are_left_out_for_it() -> None:
    points = recorded()
    points[15:22, [3, 12]] = points[15:22, [12, 3]]
    expected = np.zeros(points.shape[:2], dtype=bool)
    expected[15:22, [3, 12]] = True
    assert np.array_equal(found(points), expected)


def test_a_marker_that_slips_is_left_out_from_then_on() -> None:
    points = recorded()
    points[25:, 7] += [0.0, 0.02, 0.0]
    expected = np.zeros(points.shape[:2], dtype=bool)
    expected[25:TRAIN, 7] = True
    assert np.array_equal(found(points), expected)


def test_held_out_frames_are_not_looked_at() -> None:
    points = recorded()
    points[TRAIN + 3] += 0.05
    assert not found(points).any()


def test_a_recording_that_leaps_everywhere_is_left_as_it_is() -> None:
    points = recorded()
    points[::3] += 0.05
    assert not found(points).any()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_points(count: int) -> None:
    start = START[:count]
    points = recorded(0, 0.0, start)
    assert not found(points, None, start).any()
    points[20] += 0.05
    assert np.flatnonzero(found(points, None, start).any(axis=1)).tolist() == [20]


def test_points_out_of_sight() -> None:
    visible = np.random.default_rng(3).uniform(size=(FRAMES, len(START))) > 0.15
    visible[0], visible[10], visible[:TRAIN, 5] = True, False, False
    points = np.where(visible[..., None], recorded(), np.nan)
    points[25:, 7] += [0.0, 0.02, 0.0]
    wrong = found(points, visible)
    assert not (wrong & ~visible).any() and set(np.flatnonzero(wrong.any(axis=0))) == {7}
