"""The baselines on motions whose answer is known."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from physworld.evaluate import baselines
from physworld.evaluate.table import held_out_table
from physworld.scene import Grip, Scene

ROUNDING = 1e-9  # metres; positions of order one through a few rotations


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def scene_of(points: np.ndarray, controllers: np.ndarray, **facts: object) -> Scene:
    """A scene of T frames at 10 Hz, the last three held out, everything visible unless said."""
    frames = len(points)
    declared = {
        "name": "test",
        "kind": "beam",
        "points": points,
        "visible": np.ones(points.shape[:2], bool),
        "controllers": controllers,
        "times": np.arange(frames) / 10.0,
        "gravity_m_s2": np.array([0.0, 0.0, -9.81]),
        "noise_sigma_m": 1e-3,
        "train": (0, frames - 3),
        "test": (frames - 3, frames),
    }
    return Scene(**{**declared, **facts})  # type: ignore[arg-type]


def rigid_path(shape: np.ndarray, frames: int = 8, seed: int = 0) -> np.ndarray:
    """Points (N, 3) moved rigidly over frames, (T, N, 3); frame 0 is the shape itself."""
    rng = np.random.default_rng(seed)
    axis, drift = rng.normal(size=3), rng.normal(size=3)
    return np.stack([shape @ rotation_about(axis, 0.15 * t).T + 0.05 * t * drift for t in range(frames)])


def test_static_holds_frame_0() -> None:
    points = np.random.default_rng(0).normal(size=(6, 4, 3))
    assert np.array_equal(baselines.static(scene_of(points, points[:, :1])), np.repeat(points[:1], 6, axis=0))


def test_rigid_follow_is_exact_for_a_rigid_body() -> None:
    shape = np.random.default_rng(1).normal(size=(9, 3))
    path = rigid_path(shape)
    scene = scene_of(path, path[:, :4])
    assert np.allclose(baselines.rigid_follow(scene), path, atol=ROUNDING)


def test_rigid_follow_of_two_controllers_turns_with_their_segment() -> None:
    segment = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    beyond = np.array([[0.3, 0.0, 0.0], [0.2, 0.0, 0.05]])
    turn = [rotation_about(np.array([0.0, 0.0, 1.0]), 0.4 * t) for t in range(5)]
    controllers = np.stack([segment @ r.T + [0.0, 0.0, 0.1 * t] for t, r in enumerate(turn)])
    expected = np.stack([beyond @ r.T + [0.0, 0.0, 0.1 * t] for t, r in enumerate(turn)])
    scene = scene_of(np.repeat(beyond[None], 5, axis=0), controllers)
    assert np.allclose(baselines.rigid_follow(scene), expected, atol=ROUNDING)


def test_rigid_follow_of_one_controller_is_a_shift() -> None:
    shape = np.random.default_rng(2).normal(size=(5, 3))
    shift = np.linspace(0, 1, 6)[:, None, None] * np.array([1.0, -2.0, 0.5])
    scene = scene_of(np.repeat(shape[None], 6, axis=0), np.zeros((6, 1, 3)) + shift)
    assert np.allclose(baselines.rigid_follow(scene), shape[None] + shift, atol=ROUNDING)


def test_points_follow_the_grip_they_sit_in_and_blend_half_way() -> None:
    frames = 5
    lift = np.zeros((frames, 1, 3))
    lift[:, 0, 2] = np.arange(frames) * 0.1
    left, right = np.zeros((frames, 1, 3)), lift + np.array([1.0, 0.0, 0.0])
    points = np.repeat(np.array([[[0.0, 0, 0], [1.0, 0, 0], [0.5, 0, 0]]]), frames, axis=0)
    predicted = baselines.rigid_follow(scene_of(points, np.concatenate([left, right], axis=1)))
    assert np.allclose(predicted[-1, :, 2], [0.0, 0.4, 0.2], atol=1e-6)


def test_declared_grips_decide_the_groups() -> None:
    path = rigid_path(np.random.default_rng(3).normal(size=(6, 3)))
    scene = scene_of(path, path, grips=(Grip((0, 1, 2)), Grip((3, 4))))
    assert [g.tolist() for g in baselines.controller_groups(scene)] == [[0, 1, 2], [3, 4], [5]]


def test_undeclared_grips_are_found_by_the_distances_they_keep() -> None:
    a = rigid_path(np.random.default_rng(4).normal(size=(3, 3)), seed=1)
    b = rigid_path(np.random.default_rng(5).normal(size=(2, 3)) + 3.0, seed=9)
    scene = scene_of(a, np.concatenate([a[:, :2], b, a[:, 2:]], axis=1))
    assert [g.tolist() for g in baselines.controller_groups(scene)] == [[0, 1, 4], [2, 3]]


def test_without_controllers_nothing_follows() -> None:
    points = np.random.default_rng(0).normal(size=(6, 4, 3))
    scene = scene_of(points, np.zeros((6, 0, 3)))
    assert np.array_equal(baselines.rigid_follow(scene), baselines.static(scene))


def test_constant_velocity_is_exact_for_a_uniform_motion_at_uneven_times() -> None:
    times = np.array([0.0, 0.1, 0.25, 0.3, 0.5, 0.9, 1.0])
    start, velocity = np.random.default_rng(6).normal(size=(2, 4, 3))
    points = start + times[:, None, None] * velocity
    visible = np.ones((7, 4), bool)
    visible[2, 1] = False
    points_seen = np.where(visible[..., None], points, 1e6)
    scene = scene_of(points_seen, points[:, :1], times=times, visible=visible)
    assert np.allclose(baselines.constant_velocity(scene), points, atol=ROUNDING)


def test_constant_velocity_stays_where_only_one_early_frame_is_seen() -> None:
    points = np.cumsum(np.ones((7, 1, 3)), axis=0)
    visible = np.ones((7, 1), bool)
    visible[1:4] = False
    predicted = baselines.constant_velocity(scene_of(points, points, visible=visible))
    assert np.array_equal(predicted, np.repeat(points[:1], 7, axis=0))


def test_persistence_holds_the_last_training_place_and_no_later_one() -> None:
    points = np.arange(8.0)[:, None, None] * np.ones((1, 1, 3))
    visible = np.ones((8, 1), bool)
    visible[4] = False
    predicted = baselines.persistence(scene_of(points, points, visible=visible))
    assert predicted[:, 0, 0].tolist() == [0, 1, 2, 3, 3, 3, 3, 3]


def test_a_point_hidden_at_the_start_starts_where_it_was_first_seen_in_training() -> None:
    points = np.arange(8.0)[:, None, None] * np.ones((1, 3, 3))
    visible = np.ones((8, 3), bool)
    visible[:2, 1] = False
    visible[:5, 2] = False  # only seen in the held-out frames
    start = baselines.start_positions(scene_of(points, points, visible=visible))
    assert start[:, 0].tolist() == [0.0, 2.0, 1.0]


def test_all_points_hidden_in_training_is_an_error() -> None:
    points = np.zeros((8, 2, 3))
    visible = np.zeros((8, 2), bool)
    with pytest.raises(ValueError, match="none of the 2 points"):
        baselines.start_positions(scene_of(points, points, visible=visible))


@given(st.integers(0, 2**31), st.integers(1, 7), st.floats(-3.1, 3.1))
def test_rigid_motion_is_a_proper_rotation_and_maps_rigid_points(seed: int, count: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    rest = rng.normal(size=(count, 3))
    turn = rotation_about(rng.normal(size=3), angle)
    now = rest @ turn.T + rng.normal(size=3)
    rotation, centre, centre_now = baselines.rigid_motion(rest, now)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=ROUNDING)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert np.allclose((rest - centre) @ rotation.T + centre_now, now, atol=1e-6)


def test_a_segment_turned_round_is_half_a_turn_and_no_mirror() -> None:
    rest = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    rotation, _, _ = baselines.rigid_motion(rest, -rest)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert np.allclose(rotation @ [1.0, 0, 0], [-1.0, 0, 0])


def test_table_has_every_baseline_and_prediction_and_is_plain_json() -> None:
    path = rigid_path(np.random.default_rng(7).normal(size=(9, 3)), frames=10)
    visible = np.ones((10, 9), bool)
    visible[8] = False
    scene = scene_of(path, path[:, :4], visible=visible)
    table = held_out_table(scene, {"twin": path + np.array([1e-3, 0.0, 0.0])})
    assert json.loads(json.dumps(table, allow_nan=False)) == table
    names = {"static", "rigid_follow", "constant_velocity", "persistence", "twin"}
    for metric in ("track_m", "track_phystwin_m", "chamfer_phystwin_m", "chamfer_l2_m"):
        assert set(table[metric]) == names
    assert table["track_m"]["twin"] == pytest.approx(1e-3)
    assert table["track_phystwin_m"]["twin"] == pytest.approx(2e-3 / 3)
    assert table["track_m"]["rigid_follow"] == pytest.approx(0.0, abs=ROUNDING)
    assert table["track_m"]["static"] > 0.1
    assert table["noise_floor_m"] == pytest.approx(1e-3 * np.sqrt(8 / np.pi))
    assert table["frames"] == [7, 10]
    assert table["per_frame"]["frames"] == [7, 8, 9]
    assert table["per_frame"]["track_m"]["twin"][1] is None


def test_frame_0_is_never_scored() -> None:
    path = rigid_path(np.random.default_rng(7).normal(size=(4, 3)), frames=5)
    scene = scene_of(path, path, train=(3, 5), test=(0, 3))
    assert held_out_table(scene, {})["frames"] == [1, 3]


def test_a_prediction_of_another_shape_is_refused_by_name() -> None:
    path = rigid_path(np.random.default_rng(7).normal(size=(4, 3)))
    with pytest.raises(ValueError, match=r"twin has shape \(8, 3, 3\)"):
        held_out_table(scene_of(path, path), {"twin": path[:, :3]})
    with pytest.raises(ValueError, match="static"):
        held_out_table(scene_of(path, path), {"static": path})
