"""The object's pixels in the first frame: a box that a person draws, grown by depth and by colour.

Depth first: what stands in the box at another distance than its middle, or on the ground, is background. Colour then:
GrabCut (Rother, Kolmogorov, Blake 2004; OpenCV), which knows everything outside of the box as background, so that
a gripper that reaches into the box goes with the gripper outside. Pixels without depth belong to the mask where
colour says so.

In another camera the object is within the outlines that the first ones saw: whatever of a place lies beside the mask
there, or before what is seen there, is something else, such as the gripper that holds it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.errors import TrackingFailed
from physworld.tracking.view import Box, back_project, cloud_of

BEFORE_SHARE, BEHIND_SHARE = 0.4, 0.8
"""How far before and behind its nearest large part the object may reach, in diagonals of the box."""
ROOM_M, ROOM_SHARE = 0.012, 0.1
"""Around the cloud of the other cameras: a length, and a share of its middle extent; a gripper beside it is none
of it."""
OUTLINE_PX = 2
"""Beside a mask; the error of depth moves a place so far in another picture."""
BEFORE_M = 0.015
"""Before what is seen there; two cameras measure a place so far apart."""
LEAST_BY_COLOUR = 0.5
"""Of the pixels that outlines and depth leave; where colour leaves less, it is not asked."""
GROUND_CLEARANCE_M = 0.006
ROUNDS = 6
LEAST_PIXELS = 60


def mask_in_box(
    colour: Array, depth: Array, camera: Camera, box: Box, ground_m: float | None = None
) -> Array:
    """The object's pixels (H, W) bool.

    Args:
        colour: (H, W, 3) uint8.
        depth: (H, W) [m], 0: none.
        camera: whose picture it is, in a world with z up.
        box: around the object.
        ground_m: height of the plane that it stands on or hangs above [m]; None: not known.

    Raises:
        TrackingFailed: the box has no depth, or nothing in it stands out.
    """
    height, width = depth.shape
    box = box.within(width, height)
    near = _near(depth, camera, box, ground_m)
    return _by_colour(colour, near, depth == 0, box)


@dataclass(frozen=True)
class Outline:
    """The object in a camera's first picture.

    Attributes:
        camera: whose picture it is.
        depth: (H, W) [m], 0: none.
        mask: (H, W) bool.
    """

    camera: Camera
    depth: Array
    mask: Array

    def cloud(self) -> Array:
        """Places on the object [m], (P, 3), without pixels that mix it with what is behind it where others are left."""
        near = np.where((self.depth > 0) & self.mask, self.depth, np.inf).astype(np.float32)
        nearest = cv2.erode(near, np.ones((2 * OUTLINE_PX + 1,) * 2, np.uint8))
        clean = self.mask & (self.depth < nearest + BEFORE_M)
        clean = clean if clean.sum() >= LEAST_PIXELS else self.mask
        return cloud_of(self.camera, self.depth, clean)[0]

    def holds(self, places: Array) -> Array:
        """Which of some places (P, 3) [m] may be on the object, (P,) bool; those outside of the picture may."""
        kernel = np.ones((2 * OUTLINE_PX + 1,) * 2, np.uint8)
        wide = cv2.dilate(self.mask.astype(np.uint8), kernel) > 0
        pixels, distance = self.camera.project(places)
        at = np.floor(np.where(distance[:, None] > 0, pixels, -1.0)).astype(int)
        shown = ((at >= 0) & (at < [self.camera.width, self.camera.height])).all(axis=1)
        row, column = at[shown, 1], at[shown, 0]
        behind = distance[shown] > self.depth[row, column] - BEFORE_M
        held = np.ones(len(places), dtype=bool)
        held[shown] = wide[row, column] & behind
        return held


def mask_near_cloud(
    colour: Array,
    depth: Array,
    camera: Camera,
    outlines: list[Outline],
    ground_m: float | None = None,
) -> Array:
    """The object's pixels (H, W) bool in another camera, by what the first ones saw of it.

    Args:
        colour: (H, W, 3) uint8.
        depth: (H, W) [m], 0: none.
        camera: this camera, in the world of the others.
        outlines: of the others.
        ground_m: as in ``mask_in_box``.

    Raises:
        TrackingFailed: the object is outside of the picture, or nothing stands out.
    """
    cloud = np.concatenate([outline.cloud() for outline in outlines])
    pixels, distance = camera.project(cloud)
    seen = pixels[distance > 0]
    if not len(seen):
        raise TrackingFailed("the object is behind the camera")
    low, high = np.percentile(seen, 1, axis=0), np.percentile(seen, 99, axis=0)
    margin = 0.08 * np.linalg.norm(high - low) + 4
    left, top = (int(v) for v in np.floor(low - margin))
    right, bottom = (int(v) for v in np.ceil(high + margin))
    height, width = depth.shape
    box = Box(left, top, right, bottom).within(width, height)
    extent = np.sort(np.percentile(cloud, 99, axis=0) - np.percentile(cloud, 1, axis=0))
    room = ROOM_M + ROOM_SHARE * extent[1]
    low, high = np.percentile(cloud, 1, axis=0) - room, np.percentile(cloud, 99, axis=0) + room
    inside = np.zeros(depth.shape, dtype=bool)
    inside[box.top : box.bottom, box.left : box.right] = True
    places, at = cloud_of(camera, depth, inside)
    held = ((places > low) & (places < high)).all(axis=1)
    if ground_m is not None:
        held &= places[:, 2] > ground_m + GROUND_CLEARANCE_M
    for outline in outlines:
        held &= outline.holds(places)
    near = np.zeros(depth.shape, dtype=bool)
    near[at[held, 0], at[held, 1]] = True
    beside = cv2.dilate(near.astype(np.uint8), np.ones((2 * OUTLINE_PX + 1,) * 2, np.uint8)) > 0
    try:
        mask = _by_colour(colour, near, beside & (depth == 0), box)
    except TrackingFailed:
        mask = np.zeros(depth.shape, dtype=bool)
    # of what is a few pixels wide colour leaves nothing
    return mask if mask.sum() >= LEAST_BY_COLOUR * near.sum() else _largest(near)


def _by_colour(colour: Array, near: Array, unknown: Array, box: Box) -> Array:
    """What of a box GrabCut leaves to the object, (H, W) bool.

    Args:
        colour: (H, W, 3) uint8.
        near: pixels that depth leaves to it, (H, W) bool.
        unknown: pixels without depth that may be on it, (H, W) bool.
        box: all around it is background.

    Raises:
        TrackingFailed: nothing stands out.
    """
    window = np.s_[box.top : box.bottom, box.left : box.right]
    labels = np.full(near.shape, cv2.GC_BGD, dtype=np.uint8)
    labels[window] = np.where((near | unknown)[window], cv2.GC_PR_FGD, cv2.GC_BGD)
    core = cv2.erode(near.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    if core[window].sum() < LEAST_PIXELS:
        raise TrackingFailed(
            f"{int(core[window].sum())} pixels of the box stand out by their depth, {LEAST_PIXELS} are needed"
        )
    backward, forward = np.zeros((1, 65)), np.zeros((1, 65))
    bgr = np.ascontiguousarray(colour[..., ::-1])
    cv2.setRNGSeed(0)
    cv2.grabCut(bgr, labels, None, backward, forward, ROUNDS, cv2.GC_INIT_WITH_MASK)
    mask = (labels == cv2.GC_PR_FGD) | (labels == cv2.GC_FGD)
    return _largest(mask & (near | unknown))


def _near(depth: Array, camera: Camera, box: Box, ground_m: float | None) -> Array:
    """Pixels in the box at the distance of its nearest large part, above the ground, (H, W) bool."""
    inside = np.zeros(depth.shape, dtype=bool)
    inside[box.top : box.bottom, box.left : box.right] = True
    valid = inside & (depth > 0)
    if ground_m is not None:
        rows, columns = np.nonzero(valid)
        pixels = np.stack([columns, rows], axis=1) + 0.5
        place = back_project(camera, pixels, depth[rows, columns])
        valid[rows, columns] = place[:, 2] > ground_m + GROUND_CLEARANCE_M
    if valid.sum() < LEAST_PIXELS:
        raise TrackingFailed(f"{int(valid.sum())} pixels of the box have depth, {LEAST_PIXELS} are needed")
    middle = _mode(depth[valid])
    diagonal = float(np.hypot(box.right - box.left, box.bottom - box.top))
    size = diagonal * middle / min(camera.fx, camera.fy)
    low, high = middle - BEFORE_SHARE * size, middle + BEHIND_SHARE * size
    band: Array = valid & (depth > low) & (depth < high)
    return band


def _mode(depth: Array) -> float:
    """The nearest depth [m] around which a good part of the values lie."""
    low, high = np.percentile(depth, [1, 99])
    counts, edges = np.histogram(depth, bins=max(4, int((high - low) / 0.02) + 1), range=(low, high + 1e-6))
    first = int(np.argmax(counts >= max(0.5 * counts.max(), 1)))
    return float(np.median(depth[(depth >= edges[first]) & (depth <= edges[first + 1])]))


def _largest(mask: Array) -> Array:
    """Holes closed, specks gone: the largest connected part, and those beside it of a tenth its size or more."""
    kernel = np.ones((3, 3), np.uint8)
    whole = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    count, labels, facts, _ = cv2.connectedComponentsWithStats(whole, connectivity=8)
    if count < 2:
        raise TrackingFailed("colour and depth leave nothing of the box to the object")
    area = facts[:, cv2.CC_STAT_AREA].copy()
    area[0] = 0
    kept = np.flatnonzero(area >= 0.1 * area.max())
    if area.max() < LEAST_PIXELS:
        raise TrackingFailed(f"the object has {int(area.max())} pixels, {LEAST_PIXELS} are needed")
    return np.isin(labels, kept)
