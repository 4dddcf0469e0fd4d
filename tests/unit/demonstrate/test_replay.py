"""Replays: the track itself, eased and warped, mirrored without changing what is between the grips."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.demonstrate.replay import mirrored, playback_clock, playback_duration, replayed
from physworld.geometry.rigid import rigid_motion

GROUPS = (np.array([0, 1, 2]), np.array([3]))
UP = np.array([0.0, 0.0, 1.0])


def track(frames: int = 40) -> np.ndarray:
    """Three markers that shift and turn, and one that moves on its own."""
    generator = np.random.default_rng(0)
    first = generator.uniform(size=(4, 3))
    angle = np.linspace(0.0, 0.8, frames)
    turn = np.zeros((frames, 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
    turn[:, 1, 0], turn[:, 0, 1] = np.sin(angle), -np.sin(angle)
    turn[:, 2, 2] = 1.0
    centre = first[:3].mean(axis=0)
    shift = np.linspace(0.0, 1.0, frames)[:, None] * np.array([0.1, -0.2, 0.05])
    points = np.empty((frames, 4, 3))
    points[:, :3] = centre + shift[:, None] + np.einsum("tij,nj->tni", turn, first[:3] - centre)
    points[:, 3] = first[3] - 0.5 * shift
    return points


def test_a_plain_replay_is_the_track():
    times, points = np.linspace(0.0, 2.0, 40), track()
    np.testing.assert_allclose(replayed(times, points, times), points)
    with pytest.raises(ValueError, match=r"up to 2\.1000 s of a track that ends at 2\.0000 s"):
        replayed(times, points, np.array([0.0, 2.1]))


def test_a_clock_in_single_precision_is_replayed_to_its_end():
    times, points = np.arange(22) / 30, track(22)
    rounded = times.astype(np.float32).astype(np.float64)
    assert rounded[-1] < times[-1]
    np.testing.assert_allclose(replayed(rounded, points, times), points, atol=1e-6)


@pytest.mark.parametrize("rate", [0.6, 1.0, 1.5])
def test_an_eased_playback_starts_at_rest_and_ends_with_the_track(rate):
    duration = playback_duration(3.0, rate)
    t = np.linspace(0.0, duration, 3001)
    clock = playback_clock(t, rate)
    assert clock[0] == 0.0
    assert clock[-1] == pytest.approx(3.0)
    speed = np.diff(clock) / np.diff(t)
    assert speed[0] < 1e-3
    assert speed.max() == pytest.approx(rate)
    assert np.all(np.diff(clock) > 0.0)


def test_a_mirrored_track_keeps_the_spread_and_the_grips_rigid():
    points = track()
    other = mirrored(points, GROUPS, np.zeros(3), UP)
    np.testing.assert_allclose(other[0], points[0], atol=1e-12)

    def spread(p):
        return np.linalg.norm(p[:, :3].mean(axis=1) - p[:, 3], axis=-1)

    np.testing.assert_allclose(spread(other), spread(points), atol=1e-12)
    rotation, _ = rigid_motion(points[0, :3], points[:, :3])
    turned, _ = rigid_motion(points[0, :3], other[:, :3])
    # a turn about the vertical goes the other way
    np.testing.assert_allclose(turned[-1], rotation[-1].T, atol=1e-9)
    assert np.abs(other - points).max() > 0.05


def test_mirroring_twice_gives_the_track_back():
    points = track()
    twice = mirrored(mirrored(points, GROUPS, np.zeros(3), UP), GROUPS, np.zeros(3), UP)
    np.testing.assert_allclose(twice, points, atol=1e-9)


def test_one_grip_straight_above_its_object_has_a_mirror_too():
    points = track()[:, 3:]
    other = mirrored(points, (np.array([0]),), points[0, 0] - UP, UP)
    assert np.isfinite(other).all()
    way, mirrored_way = (np.linalg.norm(p[:, 0] - p[0, 0], axis=-1) for p in (points, other))
    np.testing.assert_allclose(mirrored_way, way)
