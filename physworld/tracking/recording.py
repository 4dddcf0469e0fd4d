"""A recording of one or several cameras to the arrays of a scene: points, grips, the cloud of the first frame.

Every camera follows its own points. Those of different cameras that lie on each other in the first frame and stay
together are one place of the object; the one that tells more stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.tracking.agreement import Agreement, agreement
from physworld.tracking.depth import without_strays
from physworld.tracking.given import GivenFollower, GivenTracks
from physworld.tracking.mask import Outline, mask_in_box, mask_near_cloud
from physworld.tracking.neighbours import carried
from physworld.tracking.places import FirstPlaces, TrackConfig
from physworld.tracking.points import Follower, follow
from physworld.tracking.view import Box, View, back_project, cloud_of

CLOUD_CELL_M = 2.5e-3
MOST_OF_CLOUD, EDGE_PATCH_PX = 6000, 8
"""Pixels of a cloud with edges, and half the side of the patch whose plane gives each its depth."""
LEAST_SHARE_SEEN = 0.1
"""Of the frames; a point that is seen less is left out."""
SAME_PLACE = 0.5
"""Of the distance between neighbouring points: nearer ones of two cameras are one."""
ON_PATCH_M, PATCH_POINTS = 6e-3, 60
TOGETHER = 2.0
"""Of that distance: how far apart the two are later, in the median."""


@dataclass(frozen=True)
class Masks:
    """The object in the first frame.

    Attributes:
        each: its pixels, (H, W) bool; None: this camera does not show it.
        left_out: why, by the camera's number.
        agreements: of the cameras with the one that shows it first.
    """

    each: list[Array | None]
    left_out: dict[int, str]
    agreements: list[Agreement]


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
        shared: places that two cameras followed and that count once.
        noise_m: of each camera's points per axis; None: not known.
        left_out: why a camera follows nothing, by its number.
    """

    points: Array
    visible: Array
    colours: Array
    cameras: Array
    cloud: Array
    masks: list[Array]
    pixels: Array
    views: list[View]
    shared: int
    noise_m: list[float | None]
    left_out: dict[int, str]


def masks_of(
    views: list[View], boxes: list[Box | None], given: list[Array | None], ground_m: float | None
) -> Masks:
    """The object in every camera's first frame: as given, in its box, or within the outlines that these saw.

    Args:
        views: the cameras.
        boxes: one a camera, or None.
        given: masks that somebody made, (H, W) bool, or None.
        ground_m: height of the ground [m], or None.

    Raises:
        TrackingFailed: no camera has a box or a mask, the first one does not show the object, or cameras disagree.
    """
    masks: list[Array | None] = [None] * len(views)
    outlines = []
    for number, view in enumerate(views):
        box, mask = boxes[number], given[number]
        if mask is None and box is not None:
            mask = mask_in_box(view.colour(0), view.depth(0), view.camera, box, ground_m)
        if mask is not None:
            masks[number] = mask
            outlines.append(Outline(view.camera, view.depth(0), mask))
    if not outlines:
        raise TrackingFailed("where is the object? Give a box or a mask in the first frame of a camera")
    first = next(number for number, mask in enumerate(masks) if mask is not None)
    agreements = agreement(views, first, outlines[0].cloud()) if len(views) > 1 else []
    left_out = {}
    for number, view in enumerate(views):
        if masks[number] is None:
            try:
                masks[number] = mask_near_cloud(
                    view.colour(0), view.depth(0), view.camera, outlines, ground_m
                )
            except TrackingFailed as error:
                left_out[number] = str(error)
    return Masks(masks, left_out, agreements)


def follow_all(
    views: list[View],
    masks: Masks,
    config: TrackConfig | None = None,
    progress: Callable[[int, int, str], None] = lambda done, total, message: None,
    given: dict[int, GivenTracks] | None = None,
    noise_of: Callable[[Array, Array], float | None] = lambda points, visible: None,
) -> Followed:
    """Tracks of all cameras as one.

    Args:
        views: the cameras, in one world, at the same moments.
        masks: of ``masks_of``.
        config: how.
        progress: told frames done, frames of all cameras, and a message.
        given: tracks that another tracker made, by the camera's number; the others are followed here.
        noise_of: deviation per axis [m] of points (T, N, 3) where visible (T, N).

    Raises:
        TrackingFailed: no camera can follow enough points.
    """
    config = config or TrackConfig()
    left_out = dict(masks.left_out)
    followers: dict[int, Follower | GivenFollower] = {}
    for number, (view, mask) in enumerate(zip(views, masks.each, strict=True)):
        if mask is None:
            continue
        try:
            followers[number] = (
                GivenFollower(view, mask, given[number], config)
                if given and number in given
                else Follower(view, mask, config)
            )
        except TrackingFailed as error:
            left_out[number] = str(error)
    if not followers:
        reasons = "; ".join(f"camera {number}: {reason}" for number, reason in sorted(left_out.items()))
        raise TrackingFailed(reasons or "no camera shows the object")
    for frame in range(1, views[0].frames):
        _step(followers, frame, config)
        progress(frame + 1, views[0].frames, f"{len(followers)} cameras")
    found = [(number, follower.tracks()) for number, follower in followers.items()]
    points = np.concatenate([tracks.points for _, tracks in found], axis=1)
    visible = np.concatenate([tracks.visible for _, tracks in found], axis=1)
    owner = np.concatenate([np.full(tracks.visible.shape[1], number) for number, tracks in found])
    noise: list[float | None] = [None] * len(views)
    for number, tracks in found:
        noise[number] = noise_of(tracks.points, tracks.visible)
    known = [sigma for sigma in noise if sigma]
    usual = float(np.median(known)) if known else 1.0
    chosen, shared = distinct(points, visible, owner, np.array([sigma or usual for sigma in noise]))
    outlines = [
        cloud_of(view.camera, depth, without_strays(depth, view.camera, mask))[0]
        for view, mask, depth in zip(views, masks.each, [view.depth(0) for view in views], strict=True)
        if mask is not None
    ]
    return Followed(
        points[:, chosen],
        visible[:, chosen],
        np.concatenate([tracks.colours for _, tracks in found])[chosen],
        owner[chosen],
        thinned(np.concatenate(outlines), CLOUD_CELL_M),
        [np.zeros((0, 0), dtype=bool) if mask is None else mask for mask in masks.each],
        np.concatenate([tracks.pixels for _, tracks in found], axis=1)[:, chosen],
        views,
        shared,
        noise,
        left_out,
    )


def edged_cloud(views: list[View], masks: list[Array]) -> Array:
    """Places (S, 3) [m] of pixels on the object in the first frame, those of its edges among them.

    A depth camera loses edges, a colour camera does not: every pixel has the depth of the plane through what is
    measured of the object around it.

    Args:
        views: the cameras.
        masks: the object in each, (H, W) bool, or of no size.
    """
    found: list[Array] = []
    rng = np.random.default_rng(0)
    for view, mask in zip(views, masks, strict=True):
        if not mask.size:
            continue
        rows, columns = np.nonzero(mask)
        most = MOST_OF_CLOUD // len(views)
        if len(rows) > most:
            chosen = np.sort(rng.choice(len(rows), most, replace=False))
            rows, columns = rows[chosen], columns[chosen]
        depth = np.where(without_strays(view.depth(0), view.camera, mask), view.depth(0), 0.0)
        pixels = np.stack([columns, rows], axis=1) + 0.5
        distance = FirstPlaces(view.camera, mask, depth, pixels, EDGE_PATCH_PX).distance
        fine = np.isfinite(distance)
        found.append(back_project(view.camera, pixels[fine], distance[fine]))
    return np.concatenate(found)


def _step(followers: dict[int, Follower | GivenFollower], frame: int, config: TrackConfig) -> None:
    """The next frame of all cameras, those that saw most in the last one first: they tell the others where to look."""
    before = sorted(followers.values(), key=lambda one: -float(one.visible[frame - 1].mean()))
    start, now = np.zeros((0, 3)), np.zeros((0, 3))
    for one in before:
        one.step(frame, carried(one.first, start, now, config.neighbours))
        seen = one.visible[frame]
        start, now = np.concatenate([start, one.first[seen]]), np.concatenate([now, one.points[frame, seen]])


def patch_points(views: list[View], box: Box) -> Array:
    """Points on a picked patch in every frame [m], (T, Q, 3), nan where not seen, followed by all that show it.

    Args:
        views: the cameras.
        box: around it in the first camera's first picture.

    Raises:
        TrackingFailed: no camera can follow enough of it.
    """
    camera, depth = views[0].camera, views[0].depth(0)
    mask = np.zeros(depth.shape, dtype=bool)
    mask[box.top : box.bottom, box.left : box.right] = True
    outline = Outline(camera, depth, mask)
    patch = cKDTree(cloud_of(camera, depth, mask)[0])
    paths, reasons = [], []
    for number, view in enumerate(views):
        if number:
            measured = view.depth(0)
            places, at = cloud_of(view.camera, measured, np.ones(measured.shape, dtype=bool))
            near = outline.holds(places)
            near[near] = patch.query(places[near], distance_upper_bound=ON_PATCH_M)[0] < ON_PATCH_M
            mask = np.zeros(measured.shape, dtype=bool)
            mask[at[near, 0], at[near, 1]] = True
        try:
            tracks = follow(view, mask, TrackConfig(points=PATCH_POINTS))
        except TrackingFailed as error:
            reasons.append(f"the patch, camera {number}: {error}")
            continue
        paths.append(np.where(tracks.visible[..., None], tracks.points, np.nan))
    if not paths:
        raise TrackingFailed("; ".join(reasons))
    return np.concatenate(paths, axis=1)


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


def distinct(points: Array, visible: Array, owner: Array, noise_m: Array) -> tuple[Array, int]:
    """Indices of points that are seen long enough, every place once, and how many counted for another camera's.

    Two cameras' points are one place if they lie on each other in the first frame and stay together where both are
    seen. The one that is seen longer stays; if both are by a tenth of the frames, the one of the better camera.

    Args:
        points: [m], (T, N, 3).
        visible: (T, N) bool.
        owner: the camera of each, (N,).
        noise_m: of every camera, (C,).
    """
    first, seen = points[0], visible.sum(axis=0)
    spacing = [
        np.median(cKDTree(own).query(own, k=2)[0][:, 1])
        for own in (first[owner == number] for number in np.unique(owner))
        if len(own) > 1
    ]
    reach = SAME_PLACE * float(np.median(spacing)) if spacing else 0.0
    pairs = cKDTree(first).query_pairs(reach, output_type="ndarray") if reach > 0 else np.zeros((0, 2), int)
    pairs = pairs[owner[pairs[:, 0]] != owner[pairs[:, 1]]]
    tenths = np.round(10.0 * seen / len(points))
    worth = tenths - 0.5 * noise_m[owner] / noise_m.max()
    dropped = seen < LEAST_SHARE_SEEN * len(points)
    shared = 0
    for one, other in pairs[np.argsort(-worth[pairs].max(axis=1), kind="stable")]:
        if dropped[one] or dropped[other]:
            continue
        both = visible[:, one] & visible[:, other]
        apart = np.linalg.norm(points[both, one] - points[both, other], axis=1)
        if len(apart) and np.median(apart) <= TOGETHER * reach:
            dropped[other if worth[one] >= worth[other] else one] = True
            shared += 1
    return np.flatnonzero(~dropped), shared
