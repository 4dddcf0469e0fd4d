"""Points on a thin round body, moved from the side that their camera sees onto its middle line.

A patch as wide as a rope shows the half of it that faces the camera, however the rope turns: a column of pixels that
lies x beside the middle is sqrt(r^2 - x^2) before it, along a ray that meets the line at a right angle, and farther on
a slanting one. Were all columns measured, that would be r pi / 4 on average; a depth camera loses those at the edges.
Taken as a place on the surface, a point would have to go round with the section.
"""

from __future__ import annotations

import cv2
import numpy as np

from physworld.arrays import Array
from physworld.tracking.depth import without_strays
from physworld.tracking.neighbours import nearest
from physworld.tracking.view import View

NEIGHBOURS = 8
"""Points that show how the body runs."""
LEAST_SINE = 0.5
"""Between ray and body: what points at its camera is not moved on and on."""


def onto_middle(
    points: Array,
    visible: Array,
    owner: Array,
    views: list[View],
    masks: list[Array],
    radius_m: float,
    patch_px: int,
) -> Array:
    """The points (T, N, 3) [m] on the middle line; those of cameras in which the body is wider than a patch stay.

    Args:
        points: as followed [m], (T, N, 3), perhaps nan where not visible.
        visible: (T, N) bool.
        owner: the camera of each, (N,).
        views: the cameras.
        masks: the body in every camera's first frame, (H, W) bool, or of no size.
        radius_m: of the body.
        patch_px: half the side of the patch whose depth was taken.
    """
    eyes = np.stack([view.camera.centre for view in views])[owner]
    before = np.array([seen_before(view, mask, radius_m) for view, mask in zip(views, masks, strict=True)])
    rays = points - eyes
    distance = np.linalg.norm(rays, axis=2, keepdims=True)
    rays = rays / distance
    focal = np.array([view.camera.fx for view in views])[owner]
    narrow = 2.0 * radius_m * focal / distance[0, :, 0] <= 2 * patch_px + 1
    close = nearest(points[0], min(NEIGHBOURS, points.shape[1] - 1))
    along = np.stack([_along(now[close], seen[close]) for now, seen in zip(points, visible, strict=True)])
    sine = np.linalg.norm(np.cross(rays, along), axis=2, keepdims=True)
    shift = rays * (before[owner, None] / np.maximum(sine, LEAST_SINE))
    moved: Array = np.where(narrow[:, None], points + shift, points)
    return moved


def seen_before(view: View, mask: Array, radius_m: float) -> float:
    """How far before its middle line a camera measures a round body on average [m], by the pixels that have depth.

    Args:
        view: the camera.
        mask: the body in its first frame, (H, W) bool, or of no size.
        radius_m: of the body.
    """
    whole = 0.25 * np.pi * radius_m
    if not mask.size:
        return whole
    depth = view.depth(0)
    measured = without_strays(depth, view.camera, mask)
    if not measured.any():
        return whole
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)[measured] - 0.5
    beside = 1.0 - np.clip(inside * depth[measured] / (radius_m * view.camera.fx), 0.0, 1.0)
    return float(radius_m * np.sqrt(1.0 - beside**2).mean())


def _along(places: Array, seen: Array) -> Array:
    """Directions (N, 3) along which neighbours (N, K, 3) lie, where seen (N, K)."""
    weight = seen[..., None].astype(np.float64)
    known = np.where(seen[..., None], places, 0.0)
    middle = (weight * known).sum(axis=1, keepdims=True) / np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    off = weight * (known - middle)
    found: Array = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))[1][..., -1]
    return found
