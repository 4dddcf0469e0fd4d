"""Limits from the recording: floors from the size, training frames only, material between the grips."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from physworld.demonstrate.limits import (
    REACH_FLOOR,
    SPEED_FLOOR,
    limits_of,
    material_between,
    material_paths,
    training_track,
)


def test_a_still_recording_still_allows_motion(held_block, block_twin):
    limits = limits_of(held_block(moving=False), block_twin)
    size = limits.size_m
    assert 0.2 <= size < 0.23  # cells end at the grips, and so a little beyond the block
    np.testing.assert_allclose(limits.reach_max_m, REACH_FLOOR * size)
    np.testing.assert_allclose(limits.reach_min_m, -REACH_FLOOR * size)
    assert limits.speed_m_s == pytest.approx(SPEED_FLOOR * size)


def test_the_recording_widens_the_limits_by_its_training_frames_only(block, block_twin):
    fast = block.controllers.copy()
    t = block.times
    fast[:, 3:, 0] -= (0.1 * np.sin(np.pi * t / t[block.train[1] - 1]) ** 2)[:, None]
    limits = limits_of(replace(block, controllers=fast), block_twin)
    assert limits.reach_min_m[0] == pytest.approx(-0.1, abs=1e-3)
    # what happens on the held-out frames must not be seen
    leaky = fast.copy()
    leaky[block.test[0] :] += 7.0
    again = limits_of(replace(block, controllers=leaky), block_twin)
    np.testing.assert_array_equal(again.reach_max_m, limits.reach_max_m)
    assert again.speed_m_s == limits.speed_m_s


def test_the_training_track_ends_with_the_training_frames(block):
    times, track = training_track(block)
    assert times[0] == 0.0
    assert times[-1] == pytest.approx(block.times[block.train[1] - 1])
    np.testing.assert_array_equal(track, block.controllers[: block.train[1]])
    fine = np.linspace(0.0, block.times[-1], 500)
    finer = replace(block, control_times=fine, control_points=np.repeat(block.controllers[:1], 500, axis=0))
    times, track = training_track(finer)
    assert times[-1] == pytest.approx(block.times[block.train[1] - 1])
    assert len(times) > 300 and len(track) == len(times)


def test_grips_do_not_part_further_than_the_material_between_them(block, block_twin):
    limits = limits_of(block, block_twin)
    assert len(limits.grips) == 2
    seen = block.controllers[: block.train[1]]
    recorded = np.linalg.norm(seen[:, 3:].mean(axis=1) - seen[:, :3].mean(axis=1), axis=-1)
    assert limits.spread_max_m[0, 1] >= recorded.max()
    assert limits.spread_max_m[0, 1] <= 1.02 * recorded.max()
    assert 0.0 < limits.spread_min_m[0, 1] < recorded.min()


def test_a_folded_rope_has_the_length_of_its_material():
    count = 200
    rest = np.zeros((count, 3))
    rest[:, 0] = np.linspace(0.0, 1.0, count)
    folded = np.stack([0.5 - np.abs(rest[:, 0] - 0.5), np.zeros(count), np.zeros(count)], axis=1)
    folded[:, 1] = 0.02 * (rest[:, 0] > 0.5)
    ends = folded[[0, -1]]
    assert np.linalg.norm(ends[1] - ends[0]) < 0.05
    assert material_paths(rest, folded, ends)[0, 1] == pytest.approx(1.0, rel=1e-9)


def test_a_grip_that_holds_two_parts_is_no_distance_from_itself():
    rest = np.concatenate(
        [np.linspace(0.0, 1.0, 40)[:, None] * [1.0, 0.0, 0.0] + [0.0, y, 0.0] for y in (0, 9)]
    )
    paths = material_paths(rest, rest, rest[[0, 40, 39]])
    assert np.isinf(paths[0, 1])
    between = material_between((np.array([0, 1]), np.array([2])), paths)
    np.testing.assert_array_equal(between, [[0.0, np.inf], [np.inf, 0.0]])


def test_markers_of_one_clamp_are_one_grip(held_block, block_twin):
    still = held_block(moving=False)
    # as if every marker of the left clamp were a group of its own
    split = (np.array([0]), np.array([1]), np.array([2]), np.array([3, 4, 5]))
    limits = limits_of(still, replace(block_twin, controller_groups=split))
    assert [sorted(grip.tolist()) for grip in limits.grips] == [[0, 1, 2], [3, 4, 5]]


def test_the_ground_is_kept_clear(held_block, block_twin):
    limits = limits_of(held_block(ground=True), block_twin)
    assert limits.floor_m > -0.02
    assert limits.reach_min_m[2] == pytest.approx(limits.floor_m)  # the lowest controller starts at z = 0
