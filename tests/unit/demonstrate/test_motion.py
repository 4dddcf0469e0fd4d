"""Motions of the grips: rigid, smooth, from rest, within every limit, reproducible, and not all alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from physworld.demonstrate.limits import limits_of
from physworld.demonstrate.motion import broken_limit, random_motion, rigid_points
from physworld.demonstrate.paths import random_path
from physworld.demonstrate.patterns import patterns_for

TIMES = np.arange(0.0, 4.0, 1.0 / 240.0)
SEEDS = range(6)


@pytest.fixture(scope="module")
def limits(block, block_twin):
    return limits_of(block, block_twin)


@pytest.mark.parametrize("pattern", ["single", "lift", "push", "twist", "together", "bimanual"])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_motion_keeps_every_limit_and_starts_at_rest_at_the_first_pose(block, limits, pattern, seed):
    first = block.controllers[0]
    motion = random_motion(first, limits, TIMES, np.random.default_rng(seed), pattern)
    assert motion.pattern == pattern
    np.testing.assert_allclose(motion.points[0], first, atol=1e-12)
    assert broken_limit(motion.points, limits, TIMES) is None
    speed = np.linalg.norm(np.diff(motion.points, axis=0), axis=-1) * 240.0
    assert speed[0].max() < 0.02 * limits.speed_m_s
    assert speed.max() > 0.05 * limits.speed_m_s


@pytest.mark.parametrize("seed", SEEDS)
def test_every_grip_stays_rigid(block, limits, seed):
    motion = random_motion(block.controllers[0], limits, TIMES, np.random.default_rng(seed))
    for grip in limits.grips:
        points = motion.points[:, grip]
        distances = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
        np.testing.assert_allclose(distances, np.broadcast_to(distances[0], distances.shape), atol=1e-10)


@pytest.mark.parametrize("seed", SEEDS)
def test_velocity_and_acceleration_have_no_jumps(limits, seed):
    fine = np.arange(0.0, 3.0, 1e-3)
    path = random_path(limits, 3.0, np.random.default_rng(seed), turning=True)
    displacement, turn = path.pose(fine)
    for track in (displacement, turn):
        velocity = np.diff(track, axis=0) / 1e-3
        acceleration = np.diff(velocity, axis=0) / 1e-3
        # one step changes the velocity by acceleration · 1 ms, the acceleration by far less than its peak
        peak = np.abs(acceleration).max()
        assert np.abs(np.diff(acceleration, axis=0)).max() < 0.15 * peak


def test_patterns_move_the_grips_that_they_name(block, limits):
    first, generator = block.controllers[0], np.random.default_rng(0)

    def moved(points):
        centres = [points[:, grip].mean(axis=1) for grip in limits.grips]
        return [float(np.abs(centre - centre[0]).max()) for centre in centres]

    single = moved(random_motion(first, limits, TIMES, generator, "single").points)
    assert min(single) == pytest.approx(0.0, abs=1e-12) and max(single) > 0.005
    assert min(moved(random_motion(first, limits, TIMES, generator, "bimanual").points)) > 0.005
    together = random_motion(first, limits, TIMES, generator, "together").points
    distances = np.linalg.norm(together[:, :, None] - together[:, None], axis=-1)
    np.testing.assert_allclose(distances, np.broadcast_to(distances[0], distances.shape), atol=1e-10)


def test_hold_one_holds_one_of_three(block, block_twin):
    groups = (np.array([0, 1, 2]), np.array([3, 4, 5]), np.array([6]))
    three = np.concatenate([block.controllers, np.array([0.1, 0.0, 0.05]) + np.zeros((60, 1, 3))], axis=1)
    three[:, 6, 0] += 0.02 * np.sin(block.times)  # it moves against the others: a grip of its own
    limits = limits_of(replace(block, controllers=three), replace(block_twin, controller_groups=groups))
    assert len(limits.grips) == 3
    assert patterns_for(limits, three[0])[-1] == "hold_one"
    points = random_motion(three[0], limits, TIMES, np.random.default_rng(1), "hold_one").points
    still = [np.abs(points[:, grip] - three[0, grip]).max() < 1e-12 for grip in limits.grips]
    assert sum(still) == 1


def test_the_same_seed_gives_the_same_motion_and_another_seed_another(block, limits):
    one, two, other = (
        random_motion(block.controllers[0], limits, TIMES, np.random.default_rng(seed)).points
        for seed in (4, 4, 5)
    )
    np.testing.assert_array_equal(one, two)
    assert np.abs(one - other).max() > 0.005


def test_motions_near_the_ground_stay_above_it(held_block, block_twin):
    scene = held_block(ground=True)
    limits = limits_of(scene, block_twin)
    for seed in SEEDS:
        motion = random_motion(scene.controllers[0], limits, TIMES, np.random.default_rng(seed))
        assert motion.points[..., 2].min() >= limits.floor_m - 1e-9


def test_a_rigid_turn_about_the_centre():
    square = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])
    quarter = rigid_points(square, np.zeros((1, 3)), np.array([[0.0, 0.0, np.pi / 2]]))
    np.testing.assert_allclose(quarter[0], np.roll(square, -1, axis=0), atol=1e-12)


def test_a_broken_limit_is_named_with_its_numbers(block, limits):
    far = np.repeat(block.controllers[:1], 3, axis=0)
    far[1:] += 10.0
    assert "its reach is" in str(broken_limit(far, limits, np.arange(3.0)))
    fast = np.repeat(block.controllers[:1], 2, axis=0)
    fast[1] += 0.01
    assert "the limit is" in str(broken_limit(fast, limits, np.array([0.0, 1e-4])))
