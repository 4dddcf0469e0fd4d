"""Paths without the noise of their measurement: errors below it, and uncertainties that are true."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physworld.tracking.rigid import RigidPath, without_noise
from physworld.tracking.smoothing import smoothed, white_deviation

FRAMES, NOISE = 90, 1e-3
TIMES = np.arange(FRAMES) / 30.0


def motion() -> np.ndarray:
    """A path (T, 1) [m] of 5 cm that takes a second and a half, and rests before."""
    since = np.maximum(TIMES - 0.4, 0.0)
    return (0.05 * (1.0 - np.exp(-((since / 0.3) ** 2))) * np.sin(4.0 * since))[:, None]


def noisy(rng: np.random.Generator) -> np.ndarray:
    return motion() + rng.normal(scale=NOISE, size=(FRAMES, 1))


def test_fifth_differences_tell_the_noise_and_not_the_motion() -> None:
    seen = np.ones(FRAMES, dtype=bool)
    found = white_deviation(noisy(np.random.default_rng(0)), seen)
    assert found is not None and found[0] == pytest.approx(NOISE, rel=0.25)
    still = white_deviation(motion(), seen)
    assert still is not None and still[0] < 0.02 * NOISE
    assert white_deviation(motion(), np.arange(FRAMES) % 5 > 0) is None


def test_the_path_is_nearer_than_its_measurement_and_says_by_how_much() -> None:
    rng = np.random.default_rng(1)
    seen = np.ones(FRAMES, dtype=bool)
    seen[40:46] = False
    errors, spreads, inside = [], [], []
    for _ in range(8):
        found = smoothed(noisy(rng), np.full((FRAMES, 1), NOISE), seen, 64, rng)
        errors.append(found.values - motion())
        spreads.append(found.deviations)
        inside.append(np.abs(errors[-1]) < 1.96 * found.deviations)
        alike = found.draws.std(axis=0)
        assert np.median(alike / found.deviations) == pytest.approx(1.0, abs=0.1)
    rms = np.sqrt(np.mean(np.square(errors)))
    assert rms < 0.6 * NOISE
    assert rms == pytest.approx(float(np.sqrt(np.mean(np.square(spreads)))), rel=0.25)
    assert np.mean(inside) > 0.88  # of 0.95: how stiff the path is comes from the same 90 numbers
    assert spreads[0][43] > 1.5 * spreads[0][20]


def test_a_turn_beyond_pi_has_no_seam() -> None:
    angles = np.linspace(0.0, 2.5 * np.pi, FRAMES)
    turns = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0])
    jitter = Rotation.from_rotvec(np.random.default_rng(3).normal(scale=1e-3, size=(FRAMES, 3)))
    shape = np.random.default_rng(4).normal(scale=0.03, size=(4, 3))
    path = without_noise(
        (jitter * turns).as_rotvec(), np.zeros((FRAMES, 3)), np.ones(FRAMES, dtype=bool), shape, 0.0
    )
    off = (Rotation.from_rotvec(path.turns) * turns.inv()).magnitude()
    assert off.max() < 1e-2


def rigid(rng: np.random.Generator) -> tuple[RigidPath, np.ndarray]:
    """A path of a marker that turns and moves, found of noisy poses; and the true carry of two points."""
    turn = 0.3 * motion() / 0.05 * [0.0, 1.0, 0.0]
    places = motion() * [0.0, 0.0, 1.0]
    seen = np.ones(FRAMES, dtype=bool)
    shape = np.array([[-0.02, 0, -0.02], [0.02, 0, -0.02], [0.02, 0, 0.02], [-0.02, 0, 0.02]])
    deviations = np.tile([2e-3, 1e-3, 2e-3, 1e-4, 1e-4, 1e-4], (FRAMES, 1))
    noise = rng.normal(size=(FRAMES, 6)) * deviations
    path = without_noise(turn + noise[:, :3], places + noise[:, 3:], seen, shape, 0.0, deviations)
    exact = RigidPath(turn, places, seen, shape, 0.0)
    return path, exact.carry(POINTS)


POINTS = np.array([[0.03, 0.0, 0.0], [0.2, 0.0, 0.0]])


def test_errors_of_a_path_are_as_large_as_they_are_said_to_be() -> None:
    rng = np.random.default_rng(5)
    off, said = [], []
    for _ in range(6):
        path, exact = rigid(rng)
        errors = path.errors(POINTS, np.array([[0.0, -0.02, -0.02], [0.24, 0.02, 0.02]]))
        assert errors.shape == (16, FRAMES, 2, 3) and np.abs(errors[:, 0]).max() < 1e-12
        off.append(path.carry(POINTS) - exact)
        said.append(np.sqrt((errors**2).sum(axis=0)))
    for point in range(2):
        rms = [float(np.sqrt(np.mean(np.square(v)[:, :, point]))) for v in (np.array(off), np.array(said))]
        assert rms[0] == pytest.approx(rms[1], rel=0.4)


def test_errors_are_none_where_no_noise_is_known() -> None:
    seen = np.ones(5, dtype=bool)
    path = without_noise(None, np.zeros((5, 3)), seen, np.zeros((1, 3)), 0.0)
    assert path.errors(POINTS, POINTS).shape == (0, 5, 2, 3)
