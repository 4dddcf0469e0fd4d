"""Whether cameras agree on where things are in the first frame, before anything is followed.

How far apart are the clouds around the object? They are laid onto each other by point-to-plane ICP (Chen & Medioni
1991) from where the calibration puts them; the motion of the object's middle is the answer. Only surfaces that look
alike are compared, so that the front of a plate, which one camera sees, is not laid onto its back. And does a
camera see through what another one saw? Then its place is wrong at large: an inverse was given for a pose, or two
cameras stand in each other's place.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.tracking.view import View, cloud_of

MOST_APART_M = 0.015
"""Clouds that are farther apart are refused."""
WARNED_APART_M = 0.005
SEEN_THROUGH_M, BESIDE_PX = 0.03, 3
MOST_SEEN_THROUGH = 0.3
"""Of the object's places that project onto depth."""
AROUND_M, CELL_M = 0.1, 4e-3
"""Beside the object, what is compared; one place a cell."""
REACHES_M = (0.06,) * 6 + (0.03,) * 6 + (0.015,) * 8
"""Between places that belong together, round after round of the ICP."""
ALIKE = 0.8
"""Cosine of normals of surfaces that may be the same."""
LEAST_PLACES = 150
HELD = 1e-3


@dataclass(frozen=True)
class Agreement:
    """Of one camera with the first one that shows the object.

    Attributes:
        camera, other: their numbers; ``other`` is the one that shows it.
        apart_m: distance of their clouds at the object; None: they see no surface together.
        places: that were compared.
        seen_through: share of the object that the camera sees through.
    """

    camera: int
    other: int
    apart_m: float | None
    places: int
    seen_through: float


def agreement(views: list[View], other: int, object_cloud: Array) -> list[Agreement]:
    """How well all cameras agree with one in the first frame.

    Args:
        views: the cameras, in one world.
        other: number of the one that shows the object.
        object_cloud: places on the object that it saw [m], (P, 3).

    Raises:
        TrackingFailed: clouds are too far apart, or a camera sees through the object; with the numbers.
    """
    found = []
    for number, view in enumerate(views):
        if number == other:
            continue
        through, by = _seen_through(view, object_cloud)
        apart, places = _apart(view, views[other], object_cloud)
        if apart is not None and apart > MOST_APART_M:
            raise TrackingFailed(
                f"the first clouds of cameras {other} and {number} are {1e3 * apart:.1f} mm apart at the object "
                f"({places} places compared); at most {1e3 * MOST_APART_M:.0f} mm are taken: calibrate again"
            )
        if through > MOST_SEEN_THROUGH:
            raise TrackingFailed(
                f"camera {number} sees through {through:.0%} of the object that camera {other} sees (what it sees "
                f"there lies {1e3 * by:.0f} mm behind in the median): one of their places in the calibration is wrong"
            )
        found.append(Agreement(number, other, apart, places, through))
    return found


def _seen_through(view: View, cloud: Array) -> tuple[float, float]:
    """Share of the places (P, 3) [m] behind which a camera sees something, and how far behind in the median [m]."""
    pixels, distance = view.camera.project(cloud)
    at = np.floor(np.where(distance[:, None] > 0, pixels, -1.0)).astype(int)
    shown = ((at >= 0) & (at < [view.camera.width, view.camera.height])).all(axis=1)
    # the nearest depth around: beside thin things the picture holds what is behind them
    depth = view.depth(0)
    kernel = np.ones((2 * BESIDE_PX + 1,) * 2, np.uint8)
    nearest = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), kernel)
    measured = np.where(np.isfinite(nearest), nearest, 0.0)[at[shown, 1], at[shown, 0]]
    behind = (measured - distance[shown])[measured > 0]
    if len(behind) < LEAST_PLACES:
        return 0.0, 0.0
    through = behind > SEEN_THROUGH_M
    return float(through.mean()), float(np.median(behind[through])) if through.any() else 0.0


def _apart(one: View, other: View, cloud: Array) -> tuple[float | None, int]:
    """How far the clouds of two cameras are apart at the object [m], or None, and the places compared."""
    middle = np.median(cloud, axis=0)
    radius = float(np.percentile(np.linalg.norm(cloud - middle, axis=1), 95)) + AROUND_M
    surfaces = [_surface(view, middle, radius) for view in (one, other)]
    if any(len(places) < LEAST_PLACES for places, _ in surfaces):
        return None, 0
    (places, normals), (there, lookings) = surfaces
    tree = cKDTree(there)
    turn, shift, count = Rotation.identity(), np.zeros(3), 0
    for reach in REACHES_M:
        moved = turn.apply(places - middle) + middle + shift
        distance, index = tree.query(moved, distance_upper_bound=reach)
        near = np.flatnonzero(np.isfinite(distance))
        near = near[np.einsum("ni,ni->n", turn.apply(normals[near]), lookings[index[near]]) > ALIKE]
        count = len(near)
        if count < LEAST_PLACES:
            return None, count
        normal = lookings[index[near]]
        arm = (moved[near] - middle) / radius
        miss = np.einsum("ni,ni->n", normal, there[index[near]] - moved[near])
        scale = 1.4826 * float(np.median(np.abs(miss))) + 1e-4
        weight = 1.0 / (1.0 + (miss / (2.0 * scale)) ** 2)
        design = np.concatenate([normal, np.cross(arm, normal)], axis=1)
        square = (design * weight[:, None]).T @ design / weight.sum() + HELD * np.eye(6)
        step = np.linalg.solve(square, (design * weight[:, None]).T @ miss / weight.sum())
        turn, shift = Rotation.from_rotvec(step[3:] / radius) * turn, shift + step[:3]
    return float(np.linalg.norm(shift)), count


def _surface(view: View, middle: Array, radius: float) -> tuple[Array, Array]:
    """Places (S, 3) [m] that a camera sees around the object, and their normals towards it (S, 3)."""
    depth = view.depth(0)
    everything = cloud_of(view.camera, depth, np.ones(depth.shape, dtype=bool))[0]
    near = everything[((everything - middle) ** 2).sum(axis=1) < radius**2]
    if len(near) < LEAST_PLACES:
        return np.zeros((0, 3)), np.zeros((0, 3))
    cell = max(CELL_M, radius / 50.0)
    _, index, count = np.unique(
        np.floor(near / cell).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    total = np.stack([np.bincount(index.ravel(), near[:, axis]) for axis in range(3)], axis=1)
    places = total / count[:, None]
    _, around = cKDTree(places).query(places, k=min(12, len(places)))
    local = places[around] - places[around].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))
    normals = vectors[:, :, 0]
    normals = normals * np.sign(np.einsum("ni,ni->n", normals, view.camera.centre - places))[:, None]
    flat = values[:, 0] < 0.15 * values[:, 1]
    return places[flat], normals[flat]
