"""Rotations of marker groups against known motions, and which markers are one gripper."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physworld.geometry.rigid import least_rotation, rigid_groups, rigid_motion

ROUND_OFF = 1e-12
TIMES = np.linspace(0.0, 1.0, 9)


def known_motion() -> tuple[np.ndarray, np.ndarray]:
    """Rotations (T, 3, 3), the first one the identity, and translations (T, 3)."""
    turns = Rotation.from_rotvec(TIMES[:, None] * np.array([0.8, -1.9, 0.5])).as_matrix()
    return turns, TIMES[:, None] * np.array([0.3, 0.1, -0.2])


def moved(reference: np.ndarray) -> np.ndarray:
    turns, shifts = known_motion()
    return np.einsum("tij,kj->tki", turns, reference) + shifts[:, None]


@pytest.mark.parametrize("goal", [[0.3, -0.2, 0.9], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [-1.0, 1e-7, 0.0]])
def test_the_least_rotation_takes_one_direction_to_the_other(goal: list[float]) -> None:
    start, end = np.array([2.0, 0.0, 0.0]), np.array(goal)
    turn = least_rotation(start, end)
    np.testing.assert_allclose(turn @ start / 2.0, end / np.linalg.norm(end), atol=1e-6)
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-6)
    angle = np.arccos(np.clip(start @ end / 2.0 / np.linalg.norm(end), -1.0, 1.0))
    assert abs(np.linalg.norm(Rotation.from_matrix(turn).as_rotvec()) - angle) < 1e-6


def test_least_rotations_are_taken_direction_by_direction() -> None:
    rng = np.random.default_rng(0)
    start, goal = rng.normal(size=(1, 5, 3)), rng.normal(size=(7, 5, 3))
    turn = least_rotation(start, goal)
    assert turn.shape == (7, 5, 3, 3)
    got = np.einsum("tnij,tnj->tni", turn, np.broadcast_to(start, goal.shape))
    wanted = goal / np.linalg.norm(goal, axis=2, keepdims=True) * np.linalg.norm(start, axis=2, keepdims=True)
    np.testing.assert_allclose(got, wanted, atol=ROUND_OFF)


@pytest.mark.parametrize("count", [3, 4, 9])
def test_three_and_more_markers_carry_the_full_pose(count: int) -> None:
    reference = np.random.default_rng(count).normal(size=(count, 3))
    rotations, translations = rigid_motion(reference, moved(reference))
    wanted, shifts = known_motion()
    np.testing.assert_allclose(rotations, wanted, atol=ROUND_OFF)
    np.testing.assert_allclose(translations, shifts, atol=ROUND_OFF)


def test_noise_on_a_plate_never_turns_it_inside_out() -> None:
    rng = np.random.default_rng(1)
    reference = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, 0.03, 0.0], [0.03, 0.03, 0.0]])
    tracks = moved(reference) + rng.normal(scale=2e-3, size=(len(TIMES), 4, 3))
    rotations, _ = rigid_motion(reference, tracks)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=ROUND_OFF)
    apart = Rotation.from_matrix(rotations) * Rotation.from_matrix(known_motion()[0]).inv()
    assert apart.magnitude().max() < 0.2  # 2 mm over 30 mm, some sigmas


@pytest.mark.parametrize("shares", [[0.0, 1.0], [-1.0, 0.2, 0.7, 2.0]], ids=["two", "on a line"])
def test_markers_on_a_line_carry_a_direction_but_no_twist(shares: list[float]) -> None:
    reference = np.array([0.1, 0.2, 0.3]) + np.array(shares)[:, None] * np.array([0.05, -0.02, 0.01])
    tracks = moved(reference)
    rotations, translations = rigid_motion(reference, tracks)
    got = np.einsum("tij,kj->tki", rotations, reference) + translations[:, None]
    np.testing.assert_allclose(got, tracks, atol=ROUND_OFF)
    axis = (reference[-1] - reference[0]) / np.linalg.norm(reference[-1] - reference[0])
    turns = Rotation.from_matrix(rotations).as_rotvec()
    np.testing.assert_allclose(turns @ axis, 0.0, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2])
def test_markers_in_one_place_carry_a_translation(count: int) -> None:
    reference = np.repeat([[0.1, 0.2, 0.3]], count, axis=0)
    tracks = moved(reference)
    rotations, translations = rigid_motion(reference, tracks)
    np.testing.assert_array_equal(rotations, np.broadcast_to(np.eye(3), (len(TIMES), 3, 3)))
    np.testing.assert_allclose(reference + translations[:, None], tracks, atol=ROUND_OFF)


def test_two_grippers_are_told_apart_by_their_motion() -> None:
    plate = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.0, 0.02, 0.0]])
    still = np.repeat(plate[None] + np.array([0.05, 0.0, 0.0]), len(TIMES), axis=0)
    tracks = np.concatenate([moved(plate), still], axis=1)[:, [3, 0, 4, 1, 5, 2]]
    groups = rigid_groups(tracks, reach_m=1.0)
    assert [g.tolist() for g in groups] == [[0, 2, 4], [1, 3, 5]]


def test_what_moves_alike_far_apart_is_two_grippers() -> None:
    far = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    tracks = far[None] + TIMES[:, None, None] * np.array([0.0, 0.0, 1.0])
    assert [g.tolist() for g in rigid_groups(tracks, reach_m=0.4)] == [[0], [1]]
    assert [g.tolist() for g in rigid_groups(tracks, reach_m=0.6)] == [[0, 1]]


def test_without_controllers_there_is_no_gripper() -> None:
    assert rigid_groups(np.zeros((4, 0, 3)), reach_m=1.0) == []
