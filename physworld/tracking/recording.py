"""A recording of one or several cameras to the arrays of a scene: points, grips, the cloud of the first frame.

Every camera follows its own points. Those of different cameras that lie on each other in the first frame are one
place of the object; the one that is seen longer stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.tracking.mask import Box, mask_in_box, mask_near_cloud
from physworld.tracking.points import TrackConfig, Tracks, follow
from physworld.tracking.view import View, cloud_of

CLOUD_CELL_M = 2.5e-3
LEAST_SHARE_SEEN = 0.1
"""Of the frames; a point that is seen less is left out."""
SAME_PLACE = 0.5
"""Of the distance between neighbouring points: nearer ones of two cameras are one."""


@dataclass(frozen=True)
class Followed:
    """What the cameras saw of the object.

    Attributes:
        points: [m], (T, N, 3); where not visible, where the neighbours put it.
        visible: (T, N) bool.
        colours: of the first frame, (N, 3) uint8.
        cameras: the camera that follows each point, (N,).
        cloud: of the first frame [m], (S, 3), one point a cell of 2.5 mm.
        masks: the object in every camera's first frame, each (H, W) bool.
        pixels: of all points in the camera that follows them, (T, N, 2).
        views: the cameras, in the world of the points.
    """

    points: Array
    visible: Array
    colours: Array
    cameras: Array
    cloud: Array
    masks: list[Array]
    pixels: Array
    views: list[View]


def masks_of(
    views: list[View], boxes: list[Box | None], given: list[Array | None], ground_m: float | None
) -> list[Array | None]:
    """The object in every camera's first frame: as given, in its box, or where the others' cloud is; None: not seen.

    Args:
        views: the cameras.
        boxes: one a camera, or None.
        given: masks that somebody made, (H, W) bool, or None.
        ground_m: height of the ground [m], or None.

    Raises:
        TrackingFailed: no camera has a box or a mask, or the first one does not show the object.
    """
    masks: list[Array | None] = [None] * len(views)
    clouds = []
    for number, view in enumerate(views):
        box, mask = boxes[number], given[number]
        if mask is None and box is not None:
            mask = mask_in_box(view.colour(0), view.depth(0), view.camera, box, ground_m)
        if mask is not None:
            masks[number] = mask
            clouds.append(cloud_of(view.camera, view.depth(0), mask)[0])
    if not clouds:
        raise TrackingFailed("where is the object? Give a box or a mask in the first frame of a camera")
    cloud = np.concatenate(clouds)
    for number, view in enumerate(views):
        if masks[number] is None:
            try:
                masks[number] = mask_near_cloud(view.colour(0), view.depth(0), view.camera, cloud, ground_m)
            except TrackingFailed:
                continue
    return masks


def follow_all(
    views: list[View],
    masks: list[Array | None],
    config: TrackConfig | None = None,
    progress: Callable[[int, int, str], None] = lambda done, total, message: None,
) -> Followed:
    """Tracks of all cameras as one.

    Args:
        views: the cameras, in one world, at the same moments.
        masks: of ``masks_of``.
        config: how.
        progress: told frames done, frames of all cameras, and a message.

    Raises:
        TrackingFailed: no camera can follow enough points.
    """
    kept: list[tuple[int, Tracks, Array]] = []
    reasons = []
    total = sum(view.frames for view, mask in zip(views, masks, strict=True) if mask is not None)
    for number, (view, mask) in enumerate(zip(views, masks, strict=True)):
        if mask is None:
            continue
        before = sum(views[n].frames for n, _, _ in kept)

        def told(done: int, _all: int, before: int = before, number: int = number) -> None:
            progress(before + done, total, f"camera {number}")

        try:
            kept.append((number, follow(view, mask, config, told), mask))
        except TrackingFailed as error:
            reasons.append(f"camera {number}: {error}")
    if not kept:
        raise TrackingFailed("; ".join(reasons) or "no camera shows the object")
    points = np.concatenate([tracks.points for _, tracks, _ in kept], axis=1)
    visible = np.concatenate([tracks.visible for _, tracks, _ in kept], axis=1)
    owner = np.concatenate([np.full(tracks.visible.shape[1], number) for number, tracks, _ in kept])
    chosen = _distinct(points[0], visible.mean(axis=0), owner)
    clouds = [cloud_of(views[n].camera, views[n].depth(0), mask)[0] for n, _, mask in kept]
    return Followed(
        points[:, chosen],
        visible[:, chosen],
        np.concatenate([tracks.colours for _, tracks, _ in kept])[chosen],
        owner[chosen],
        thinned(np.concatenate(clouds), CLOUD_CELL_M),
        [np.zeros((0, 0), dtype=bool) if mask is None else mask for mask in masks],
        np.concatenate([tracks.pixels for _, tracks, _ in kept], axis=1)[:, chosen],
        views,
    )


def thinned(points: Array, cell_m: float) -> Array:
    """The mean of the points of every cell, (S, 3); where cells hold several, lone ones are strays of the depth."""
    cells, index, count = np.unique(
        np.floor(points / cell_m).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    total = np.zeros((len(cells), 3))
    np.add.at(total, index.ravel(), points)
    least = 2 if np.median(count) >= 3 else 1
    means: Array = (total / count[:, None])[count >= least]
    return means


def _distinct(places: Array, seen: Array, owner: Array) -> Array:
    """Indices of points that are seen long enough and no other camera's better one lies on."""
    spacing = [
        np.median(cKDTree(own).query(own, k=2)[0][:, 1])
        for own in (places[owner == number] for number in np.unique(owner))
        if len(own) > 1
    ]
    reach = SAME_PLACE * float(np.median(spacing)) if spacing else 0.0
    pairs = cKDTree(places).query_pairs(reach, output_type="ndarray") if reach > 0 else np.zeros((0, 2), int)
    dropped = seen < LEAST_SHARE_SEEN
    for one, other in pairs[np.argsort(-seen[pairs].max(axis=1))] if len(pairs) else ():
        if owner[one] != owner[other] and not dropped[one] and not dropped[other]:
            dropped[other if seen[one] >= seen[other] else one] = True
    return np.flatnonzero(~dropped)
