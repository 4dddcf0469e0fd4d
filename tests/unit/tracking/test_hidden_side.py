"""The guessed far side of a body, on bodies whose pictures are closed forms: ellipsoids before a wall."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.camera import Camera, look_at
from physworld.geometry.filling import filled_body
from physworld.tracking.hidden_side import body_of_seen_side, outline_places
from physworld.tracking.view import View

WALL_M, NOISE_M = 0.3, 8e-4
"""Of the wall behind the body's middle; deviation of the depth."""
MIDDLE = np.array([0.0, 0.0, 0.5])


def front(camera: Camera, halves: np.ndarray, grazing_deg: float = 70.0) -> tuple[View, np.ndarray]:
    """An ellipsoid of half-axes (3,) [m] before a wall, without depth where it is seen at a grazing angle."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack(
        [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1
    ) @ camera.world_to_camera[:3, :3]  # fmt: skip
    eye = camera.centre - MIDDLE
    a, b = ((rays / halves) ** 2).sum(axis=-1), (rays * eye / halves**2).sum(axis=-1)
    inner = b**2 - a * (((eye / halves) ** 2).sum() - 1.0)
    mask = inner > 0
    depth = np.where(mask, (-b - np.sqrt(np.maximum(inner, 0.0))) / a, 0.0)
    normal = (eye + depth[..., None] * rays) / halves**2
    facing = -np.sum(normal * rays, axis=-1) / np.linalg.norm(normal, axis=-1) / np.linalg.norm(rays, axis=-1)
    behind = np.linalg.norm(eye) + WALL_M
    measured = np.where(mask, np.where(facing > np.cos(np.radians(grazing_deg)), depth, 0.0), behind)
    noisy = measured + np.random.default_rng(0).normal(0.0, NOISE_M, measured.shape)
    depth = np.where(measured > 0, noisy, 0.0).astype(np.float32)
    return View(camera, lambda frame: np.zeros((*depth.shape, 3), np.uint8), lambda frame: depth, 1), mask


def camera_at(*eye: float) -> Camera:
    return look_at(np.array(eye), MIDDLE, field_of_view_deg=40.0)


def overlap(points: np.ndarray, halves: np.ndarray) -> tuple[float, float]:
    """Intersection over union with the ellipsoid, and the volume over its own."""
    query = MIDDLE + np.random.default_rng(1).uniform(-2.0, 2.0, (20_000, 3)) * halves
    inside = (((query - MIDDLE) / halves) ** 2).sum(axis=1) < 1.0
    found = filled_body(points).contains(query)
    return float((inside & found).sum() / (inside | found).sum()), float(found.sum() / inside.sum())


@pytest.mark.parametrize("halves", [(0.05, 0.05, 0.05), (0.1, 0.03, 0.03), (0.06, 0.025, 0.06)])
def test_a_smooth_body_that_one_camera_sees_has_its_volume(halves: tuple[float, float, float]) -> None:
    view, mask = front(camera_at(0.05, -0.6, 0.7), np.array(halves))
    points = body_of_seen_side([view], [mask])
    assert points is not None
    shared, volume = overlap(points, np.array(halves))
    assert shared > 0.8 and 0.85 < volume < 1.2, (shared, volume)


def test_the_outline_lies_where_lines_of_sight_touch_though_no_depth_is_measured_there() -> None:
    camera, radius = camera_at(0.0, -0.6, 0.5), 0.05
    view, mask = front(camera, np.full(3, radius), grazing_deg=60.0)
    places, turns = outline_places(view, mask)
    away = np.linalg.norm(camera.centre - MIDDLE)
    touched = radius**2 / away  # of a sphere: the tangents' circle lies so far before the middle
    missed = (places - MIDDLE) @ np.array([0.0, -1.0, 0.0]) - touched
    assert abs(np.median(missed)) < 3e-3, np.median(missed)
    pixel = away / camera.fx
    assert np.median(turns) == pytest.approx(np.sqrt(2.0 * radius * pixel), rel=0.25)


def test_a_camera_behind_the_body_bounds_it() -> None:
    """A ball whose far part is cut off, which the first camera cannot see: the second one measures the cut, but only a
    part of its pixels is known as the ball's, so it is not the one that is mirrored."""
    halves, cut = np.full(3, 0.05), 0.015
    (near, near_mask), (far, far_mask) = (front(camera_at(0.0, side, 0.5), halves) for side in (-0.6, 0.6))
    measured = far.depth(0)
    flat = np.where(far_mask & (measured > 0), np.maximum(measured, 0.6 - cut), measured)
    behind = View(far.camera, far.colour, lambda frame: flat, 1)
    alone = body_of_seen_side([near], [near_mask])
    part = far_mask.copy()
    part[: len(part) // 2] = False
    both = body_of_seen_side([near, behind], [near_mask, part])
    assert alone is not None and both is not None
    assert alone[:, 1].max() > 2 * cut and both[:, 1].max() < cut + 0.01, (
        alone[:, 1].max(),
        both[:, 1].max(),
    )


def test_what_covers_the_body_is_not_its_outline() -> None:
    view, mask = front(camera_at(0.0, -0.6, 0.5), np.full(3, 0.05))
    depth = view.depth(0).copy()
    depth[:, : depth.shape[1] // 2] = 0.4  # a board before the left half
    half = mask.copy()
    half[:, : depth.shape[1] // 2] = False
    covered = View(view.camera, view.colour, lambda frame: depth, 1)
    places, _ = outline_places(covered, half)
    pixels, _ = view.camera.project(places)
    assert len(places) > 20 and pixels[:, 0].min() > depth.shape[1] // 2 + 1


def test_too_little_to_tell() -> None:
    view, mask = front(camera_at(0.0, -0.6, 0.5), np.full(3, 0.05))
    few = np.zeros_like(mask)
    few[240:244, 320:324] = True
    assert body_of_seen_side([view], [few]) is None
    assert body_of_seen_side([view], [np.zeros((0, 0), dtype=bool)]) is None
