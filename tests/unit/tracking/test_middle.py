"""What a camera sees of a rope is its near side; its middle line is where the section's mean is."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.camera import Camera
from physworld.tracking.depth import without_strays
from physworld.tracking.middle import onto_middle, seen_before
from physworld.tracking.recording import edged_cloud
from physworld.tracking.view import View

RADIUS_M, POINTS, DISTANCE_M = 0.006, 12, 1.0
FITS_M = 3e-4
"""What perspective leaves: a rope 6 mm thick at 1 m."""
CAMERA = Camera(width=640, height=480, fx=800.0, fy=800.0, cx=320.0, cy=240.0, world_to_camera=np.eye(4))
VIEW = View(CAMERA, lambda frame: np.zeros(0), lambda frame: np.zeros(0), 2)
UNSEEN = np.zeros((0, 0), bool)


def _line(angle_deg: float) -> np.ndarray:
    """Places along a rope (N, 3) that leaves the picture's plane by an angle."""
    along = np.array([0.0, np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    return np.array([0.0, 0.0, DISTANCE_M]) + np.linspace(-0.1, 0.1, POINTS)[:, None] * along


def _seen(line: np.ndarray) -> np.ndarray:
    """The mean of what a row of pixels across the rope sees at every place, (N, 3)."""
    along = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    across = np.cross(along, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    found = []
    for place in line:
        targets = place + np.linspace(-0.999, 0.999, 400)[:, None] * RADIUS_M * across
        rays = targets / np.linalg.norm(targets, axis=1, keepdims=True)
        offset, flat = -line[0], rays - np.outer(rays @ along, along)
        start = offset - (offset @ along) * along
        a, b, c = (flat**2).sum(axis=1), flat @ start, start @ start - RADIUS_M**2
        found.append((rays * ((-b - np.sqrt(b**2 - a * c)) / a)[:, None]).mean(axis=0))
    return np.array(found)


@pytest.mark.parametrize("angle_deg", [0.0, 40.0, -50.0])
def test_what_is_seen_of_a_rope_goes_onto_its_middle_line_however_it_leans(angle_deg: float) -> None:
    still, leaning = _line(0.0), _line(angle_deg)
    seen = np.stack([_seen(still), _seen(leaning)])
    assert np.linalg.norm(seen - [still, leaning], axis=2).min() > 0.7 * RADIUS_M
    found = onto_middle(
        seen, np.ones((2, POINTS), bool), np.zeros(POINTS, int), [VIEW], [UNSEEN], RADIUS_M, 5
    )
    off = found - np.stack([still, leaning])
    along = (leaning[-1] - leaning[0]) / np.linalg.norm(leaning[-1] - leaning[0])
    off[1] -= np.outer(off[1] @ along, along)
    assert np.linalg.norm(off, axis=2).max() < FITS_M


def test_a_rope_of_which_the_edges_are_lost_is_seen_nearer() -> None:
    mask = np.zeros((480, 640), bool)
    mask[100:300, 310:330] = True
    depth = np.where(mask, 1.0, 0.0)
    radius = 10.0 / CAMERA.fx
    view = View(CAMERA, lambda frame: np.zeros(0), lambda frame: depth, 1)
    assert seen_before(view, mask, radius) == pytest.approx(0.25 * np.pi * radius, rel=0.02)
    depth[:, 310:315] = depth[:, 325:] = 0.0  # the middle half is left
    half = 0.5 * radius * (np.sqrt(0.75) + np.arcsin(0.5) / 0.5)
    assert seen_before(view, mask, radius) == pytest.approx(half, rel=0.02)


def test_what_is_wider_than_a_patch_stays_where_it_is_seen() -> None:
    seen = _seen(_line(0.0))[None]
    found = onto_middle(seen, np.ones((1, POINTS), bool), np.zeros(POINTS, int), [VIEW], [UNSEEN], 0.02, 5)
    np.testing.assert_array_equal(found, seen)


def test_pixels_that_mix_a_rope_with_what_is_behind_it_are_none_of_its_cloud() -> None:
    depth = np.full((480, 640), 2.0)
    mask = np.zeros(depth.shape, bool)
    mask[100:300, 316:324] = True
    depth[mask] = 1.0
    mixed = np.zeros_like(mask)
    mixed[100:300:3, 323] = True
    depth[mixed] = 1.4
    kept = without_strays(depth, CAMERA, mask)
    np.testing.assert_array_equal(kept, mask & ~mixed)


def test_a_cloud_reaches_to_the_edges_that_depth_loses_on_a_slanting_body() -> None:
    depth = np.zeros((480, 640))
    mask = np.zeros(depth.shape, bool)
    mask[100:300, 316:324] = True
    slope = 1.0 / (1.0 + 5e-4 * (np.arange(480) - 200.0))  # a plane: 1/Z is linear in the pixel
    depth[104:296, 318:322] = slope[104:296, None]
    cloud = edged_cloud([View(CAMERA, lambda frame: np.zeros(0), lambda frame: depth, 1)], [mask])
    assert len(cloud) > 0.98 * mask.sum()
    pixels, distance = CAMERA.project(cloud)
    np.testing.assert_allclose(distance, slope[np.floor(pixels[:, 1] + 1e-9).astype(int)], atol=1e-3)
    assert np.ptp(pixels, axis=0) == pytest.approx([7.0, 199.0], abs=1e-6)
