"""Carrying points with vertices."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from physworld.geometry.rigid import least_rotation
from physworld.video import GaussianCarrier, Gaussians
from physworld.worldmodel.model import skinning
from physworld.worldmodel.model.skinning import (
    Skin,
    affine_skin,
    local_rotations,
    nearest_vertices,
    quaternion_of,
    quaternion_product,
    skin_beside,
)

RIDGE_ERROR = 5e-3  # of the neighbourhood: what the pull towards 1/distance costs


def _cloud(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(size=(60, 3)), rng.uniform(0.2, 0.8, size=(15, 3))


def test_affine_motions_are_carried() -> None:
    vertices, points = _cloud()
    skin = affine_skin(points, vertices)
    assert skin.weight.sum(axis=1) == pytest.approx(np.ones(15))
    turn = Rotation.from_rotvec([0.5, -1.0, 2.0]).as_matrix() * 1.2
    shift = np.array([1.0, 2.0, 3.0])
    assert skin.apply(vertices @ turn.T + shift) == pytest.approx(points @ turn.T + shift, abs=RIDGE_ERROR)


def test_a_point_that_is_a_vertex_goes_with_it() -> None:
    vertices, _ = _cloud()
    skin = affine_skin(vertices[:5], vertices)
    moved = vertices + np.random.default_rng(1).normal(0.0, 0.05, vertices.shape)
    assert skin.apply(moved) == pytest.approx(moved[:5], abs=RIDGE_ERROR)


def test_several_states_teach_what_a_plane_of_vertices_hides() -> None:
    rng = np.random.default_rng(2)
    plane = np.concatenate([rng.uniform(size=(40, 2)), np.zeros((40, 1))], axis=1)
    points = plane[:6] + np.array([0.01, 0.01, 0.0])
    bend = np.array([[x, y, 0.3 * x * x] for x, y, _ in plane])
    bent_points = np.array([[x, y, 0.3 * x * x] for x, y, _ in points])
    one = affine_skin(points, plane)
    both = affine_skin(np.stack([points, bent_points]), np.stack([plane, bend]))
    error = [np.abs(skin.apply(bend) - bent_points).max() for skin in (one, both)]
    assert error[1] < error[0]


def test_torch_and_numpy_agree_and_torch_has_gradients() -> None:
    vertices, points = _cloud()
    skin = affine_skin(points, vertices)
    moving = torch.tensor(np.stack([vertices, vertices * 1.1]), requires_grad=True)
    carried = skin.apply_torch(moving)
    assert carried.detach().numpy() == pytest.approx(skin.apply(moving.detach().numpy()))
    carried.sum().backward()
    assert float(moving.grad.sum()) == pytest.approx(2 * 15 * 3)


def _rolled_up(places: np.ndarray, curvature: float, height: float) -> np.ndarray:
    """Places (M, 2) of a plane [m], and what lies ``height`` above them, on a cylinder of that curvature: (M, 3)."""
    if curvature == 0.0:
        return np.concatenate([places, np.full((len(places), 1), height)], axis=1)
    angle, radius = curvature * places[:, 0], 1.0 / curvature - height
    return np.stack([radius * np.sin(angle), places[:, 1], 1.0 / curvature - radius * np.cos(angle)], axis=1)


CURVATURES = (0.0, 0.5, 1.0, 2.0)
HEIGHT_M = 0.05


def _beside_a_sheet(turn: Rotation) -> tuple[Skin, np.ndarray, np.ndarray]:
    """A skin learned from a sheet that is bent a little, and vertices and points of it bent more and turned."""
    lines = np.linspace(-0.5, 0.5, 25)
    places, marked = np.array([[x, y] for x in lines for y in lines]), np.array([[0.1, 0.2], [-0.23, 0.31]])
    sheets = np.stack([_rolled_up(places, c, 0.0) for c in CURVATURES])
    points = np.stack([_rolled_up(marked, c, HEIGHT_M) for c in CURVATURES])
    within = np.stack([_rolled_up(marked, c, 0.0) for c in CURVATURES])
    skin = skin_beside(affine_skin(within[:2], sheets[:2]), points[:2], sheets[:2], sheets[0])
    return skin, turn.apply(sheets[-1]), turn.apply(points[-1])


def test_points_above_a_sheet_go_along_its_normal() -> None:
    skin, sheet, points = _beside_a_sheet(Rotation.from_rotvec([0.4, 2.0, -1.0]))
    error = np.linalg.norm(skin.apply(sheet) - points, axis=1)
    assert error.max() < 0.04 * HEIGHT_M
    without = np.linalg.norm(Skin(skin.index, skin.weight).apply(sheet) - points, axis=1)
    assert without.min() > 0.9 * HEIGHT_M


def test_points_on_the_skin_of_a_rope_turn_with_its_section() -> None:
    arcs, marks = np.linspace(0.0, 1.0, 49), np.array([0.22, 0.61])
    offset = np.array([[0.0, 0.03, 0.02], [0.0, -0.01, 0.04]])

    def bent(at: np.ndarray, curvature: float) -> tuple[np.ndarray, np.ndarray]:
        """Centre line and its tangents."""
        angle = curvature * at
        place = np.stack([np.sin(angle), 1.0 - np.cos(angle), 0.0 * at], axis=1) / curvature
        return place, np.stack([np.cos(angle), np.sin(angle), 0.0 * at], axis=1)

    states = [1e-6, 0.5, 2.5]
    ropes, within = (np.stack([bent(at, c)[0] for c in states]) for at in (arcs, marks))
    tangents = np.stack([bent(marks, c)[1] for c in states])
    points = within + np.einsum("smij,mj->smi", least_rotation(tangents[0], tangents), offset)
    rest = np.stack([arcs, 0.0 * arcs, 0.0 * arcs], axis=1)
    skin = skin_beside(affine_skin(within[:2], ropes[:2]), points[:2], ropes[:2], rest)
    assert np.linalg.norm(skin.apply(ropes[-1]) - points[-1], axis=1).max() < 1e-3
    alone = Skin(skin.index, skin.weight).apply(ropes[-1]) - points[-1]
    assert np.linalg.norm(alone, axis=1).min() > 0.03


def test_offsets_of_points_are_the_same_in_torch_and_have_gradients() -> None:
    skin, sheet, _ = _beside_a_sheet(Rotation.identity())
    several = torch.tensor(np.stack([sheet, 1.1 * sheet]), requires_grad=True)
    carried = skin.apply_torch(several)
    assert carried.detach().numpy() == pytest.approx(skin.apply(several.detach().numpy()), abs=1e-12)
    assert torch.autograd.gradcheck(skin.apply_torch, (several,), nondet_tol=0.0)
    assert np.isfinite(skin.apply(np.zeros_like(sheet))).all(), "a sheet that has collapsed has no normal"


def blended(
    points: np.ndarray, rest: np.ndarray, moved: np.ndarray, quaternions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points (M, 3) and orientations (M, 4) as the carrier of Gaussians moves them with the vertices (n, 3)."""
    count = len(points)
    splat = Gaussians(points, np.zeros((count, 3)), quaternions, np.zeros(count), np.zeros((count, 1, 3)))
    carried, _ = GaussianCarrier(splat, rest).at(moved)
    return carried.means, carried.rotations


def test_linear_blend_skinning_carries_rigid_motions_and_orientations() -> None:
    vertices, points = _cloud()
    turn = Rotation.from_rotvec([0.0, 0.0, 3.0])  # beyond where blended signs go wrong
    moved = turn.apply(vertices) + 1.0
    assert local_rotations(vertices, moved) == pytest.approx(np.repeat(turn.as_matrix()[None], 60, axis=0))
    start = np.repeat(np.array([[1.0, 0.0, 0.0, 0.0]]), len(points), axis=0)
    positions, quaternions = blended(points, vertices, moved, start)
    assert positions == pytest.approx(turn.apply(points) + 1.0)
    expected = turn.as_quat(scalar_first=True)
    assert np.abs(quaternions @ expected) == pytest.approx(np.ones(len(points)))


def test_a_straight_rope_is_not_turned_about_its_own_line() -> None:
    line = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
    rope = np.linspace(0.0, 1.0, 40)[:, None] * line
    still = np.repeat(np.eye(3)[None], len(rope), axis=0)
    assert local_rotations(rope, rope + 0.1) == pytest.approx(still, abs=1e-6)
    turn, _ = Rotation.align_vectors([np.array([1.0, 0.0, 0.0])], [line])  # the least one
    moved = turn.apply(rope)
    assert local_rotations(rope, moved) == pytest.approx(turn.as_matrix() @ still, abs=1e-5)
    beside = rope[:10] + 0.02 * np.cross(line, [0.0, 0.0, 1.0])
    start = np.repeat(np.array([[1.0, 0.0, 0.0, 0.0]]), len(beside), axis=0)
    places, turns = blended(beside, rope, rope, start)
    assert places == pytest.approx(beside, abs=1e-6)
    assert turns == pytest.approx(start, abs=1e-6)


def test_rotations_are_never_reflections() -> None:
    vertices, _ = _cloud()
    mirrored = vertices * np.array([1.0, 1.0, -1.0])
    assert np.linalg.det(local_rotations(vertices, mirrored)) == pytest.approx(np.ones(60))


def test_quaternions_near_half_turns_blend_without_cancelling() -> None:
    vertices, points = _cloud()
    lean = np.where(vertices[:, :1] > 0.5, 0.02, -0.02) * np.array([[0.0, 0.0, 1.0]])
    turns = Rotation.from_rotvec(
        lean + np.array([0.0, 0.0, np.pi])
    )  # either side of a half turn: opposite signs
    centre = vertices.mean(axis=0)
    moved = turns.apply(vertices - centre)
    start = np.repeat(np.array([[1.0, 0.0, 0.0, 0.0]]), len(points), axis=0)
    _, quaternions = blended(points, vertices, moved, start)
    half_turn = np.array([0.0, 0.0, 0.0, 1.0])
    assert np.abs(quaternions @ half_turn).min() > 0.99


def test_quaternion_algebra_is_that_of_scipy() -> None:
    turns = Rotation.random(200, random_state=3)
    mine = quaternion_of(turns.as_matrix())
    theirs = turns.as_quat(scalar_first=True)
    assert np.abs((mine * theirs).sum(axis=1)) == pytest.approx(np.ones(200))
    product = quaternion_product(mine[:100], mine[100:])
    expected = (turns[:100] * turns[100:]).as_quat(scalar_first=True)
    assert np.abs((product * expected).sum(axis=1)) == pytest.approx(np.ones(100))


def test_many_states_take_no_more_memory_than_a_few_times_the_points() -> None:
    """A planner carries thousands of points through hundreds of ticks of many motions: K copies would not fit."""
    rng = np.random.default_rng(0)
    weight = rng.uniform(size=(400, 8))
    skin = Skin(rng.integers(0, 60, (400, 8)), weight / weight.sum(axis=1, keepdims=True))
    vertices = rng.normal(size=(5, 20, 60, 3))
    expected = np.einsum("mk,...mkx->...mx", skin.weight, vertices[..., skin.index, :])
    tracemalloc.start()
    points = skin.apply(vertices)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert points == pytest.approx(expected, abs=1e-13)
    assert peak < 4 * points.nbytes


def test_the_nearest_vertices_are_the_same_however_many_are_looked_at_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vertices, points = _cloud()
    whole = nearest_vertices(points, vertices, 8)
    monkeypatch.setattr(skinning, "GAPS_AT_ONCE", 4 * len(vertices))
    for part, expected in zip(nearest_vertices(points, vertices, 8), whole, strict=True):
        assert np.array_equal(part, expected)
