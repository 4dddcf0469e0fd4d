"""What several cameras follow as one: places once, grips without jumps, places that others tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracking_pictured import BOTTOM, CAMERA, LEFT, NEAR_M, RIGHT, TOP, affine, view
from tracking_pictured import FRAMES as PLATE_FRAMES

from physworld.tracking.grips import colour_middles
from physworld.tracking.mask import Outline
from physworld.tracking.neighbours import carried
from physworld.tracking.places import TrackConfig
from physworld.tracking.points import Follower
from physworld.tracking.recording import distinct, patch_points
from physworld.tracking.rigid import joined, rigid_path
from physworld.tracking.view import Box, View, back_project

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


def shown_in(frames: range) -> View:
    """The plate, in a picture without depth in all other frames."""
    whole = view()
    return replace(
        whole, depth=lambda frame: whole.depth(frame) if frame in frames else 0.0 * whole.depth(frame)
    )


def test_a_colour_and_a_patch_are_followed_by_all_cameras() -> None:
    exact = back_project(CAMERA, middle_of(range(PLATE_FRAMES)), np.full(PLATE_FRAMES, NEAR_M))
    views = [shown_in(range(8)), shown_in(range(PLATE_FRAMES))]
    path = colour_middles(views, (80, 60))
    assert np.linalg.norm(path - exact, axis=1).max() < 2e-3
    assert np.isnan(colour_middles(views[:1], (80, 60))[8:]).all()
    box = Box(LEFT + 4, TOP + 4, RIGHT - 4, BOTTOM - 4)
    one, both = patch_points(views[:1], box), patch_points(views, box)
    assert both.shape[1] > 1.5 * one.shape[1]
    assert np.isnan(one[8:]).all() and np.isfinite(both[-1]).all(axis=1).sum() > 8
    path = rigid_path(both).carry(exact[:1])[:, 0]
    assert np.linalg.norm(path - exact, axis=1).max() < 2e-3


def test_a_camera_that_lost_the_object_finds_it_where_the_others_say() -> None:
    whole = view(frames=21)
    dark = replace(
        whole, colour=lambda frame: whole.colour(frame) if frame in (0, 20) else 0 * whole.colour(frame)
    )
    mask = np.zeros((120, 160), dtype=bool)
    mask[TOP:BOTTOM, LEFT:RIGHT] = True
    config = TrackConfig(points=40, patch_px=7, depth_px=3)
    alone, told = Follower(dark, mask, config), Follower(dark, mask, config)
    pixels, depth = CAMERA.project(told.first)
    there = (pixels - 0.5) @ affine(20)[:, :2].T + affine(20)[:, 2] + 0.5
    exact = back_project(CAMERA, there, depth)
    for frame in range(1, 21):
        alone.step(frame)
        told.step(frame, exact + np.array([0.01, 0.0, 0.0]) if frame == 20 else None)
    assert alone.visible[20].mean() < 0.2 and not told.visible[1:20].any()
    assert told.visible[20].mean() > 0.8
    seen = told.visible[20]
    assert np.linalg.norm(told.points[20, seen] - exact[seen], axis=1).max() < 2e-3


def test_the_object_is_within_the_outline_that_another_camera_saw() -> None:
    depth = np.full((120, 160), 1.2, dtype=np.float32)
    mask = np.zeros((120, 160), dtype=bool)
    mask[TOP:BOTTOM, LEFT:RIGHT] = True
    depth[mask] = NEAR_M
    outline = Outline(CAMERA, depth, mask)
    pixels = np.array(
        [[80.0, 60.0]] * 3 + [[LEFT - 10.0, 60.0], [LEFT - 1.0, 60.0], [500.0, 60.0], [80.0, 60.0]]
    )
    # on the surface, behind it, before it, beside it, within the error of its rim, outside of the picture
    distance = np.array([NEAR_M, NEAR_M + 0.1, NEAR_M - 0.05, NEAR_M, NEAR_M, NEAR_M, -NEAR_M])
    held = outline.holds(back_project(CAMERA, pixels, distance))
    assert held[:6].tolist() == [True, True, False, False, False, True]
    depth[:, LEFT - 2 : LEFT] = 0.0  # without depth there the rim may be the object's
    assert outline.holds(back_project(CAMERA, pixels[4:5], distance[4:5])).all()
    # pixels that mix the object with what is behind it are none of its cloud
    depth[TOP:BOTTOM, LEFT : LEFT + 2] = 0.8
    assert np.allclose(outline.cloud()[:, 2], NEAR_M)


def middle_of(frames: range) -> np.ndarray:
    """Pixels (T, 2) of the plate's middle."""
    start = np.array([(LEFT + RIGHT) / 2, (TOP + BOTTOM) / 2]) - 0.5
    return np.stack([affine(frame)[:, :2] @ start + affine(frame)[:, 2] + 0.5 for frame in frames])
