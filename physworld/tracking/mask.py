"""The object's pixels in the first frame: a box that a person draws, grown by depth and by colour.

Depth first: what stands in the box at another distance than its middle, or on the ground, is background. Colour then:
GrabCut (Rother, Kolmogorov, Blake 2004; OpenCV), which knows everything outside of the box as background, so that
a gripper that reaches into the box goes with the gripper outside. Pixels without depth belong to the mask where
colour says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.errors import TrackingFailed
from physworld.tracking.view import back_project

BEFORE_SHARE, BEHIND_SHARE = 0.4, 0.8
"""How far before and behind its nearest large part the object may reach, in diagonals of the box."""
ROOM_M, ROOM_SHARE = 0.012, 0.1
"""Around the cloud of the other cameras: a length, and a share of its middle extent; a gripper beside it is none
of it."""
GROUND_CLEARANCE_M = 0.006
ROUNDS = 6
LEAST_PIXELS = 60


@dataclass(frozen=True)
class Box:
    """A rectangle of pixels: left, top, right, bottom; the last two are outside of it."""

    left: int
    top: int
    right: int
    bottom: int

    def within(self, width: int, height: int) -> Box:
        """The part of it that is in the picture.

        Raises:
            TrackingFailed: nothing is.
        """
        inside = Box(max(self.left, 0), max(self.top, 0), min(self.right, width), min(self.bottom, height))
        if inside.right - inside.left < 4 or inside.bottom - inside.top < 4:
            raise TrackingFailed(
                f"the box {self.left},{self.top},{self.right},{self.bottom} has nothing of the "
                f"picture of {width} x {height} px"
            )
        return inside


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
    window = np.s_[box.top : box.bottom, box.left : box.right]
    near = _near(depth, camera, box, ground_m)
    labels = np.full((height, width), cv2.GC_BGD, dtype=np.uint8)
    labels[window] = np.where(near[window] | (depth[window] == 0), cv2.GC_PR_FGD, cv2.GC_BGD)
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
    return _largest(mask & (near | (depth == 0)))


def mask_near_cloud(
    colour: Array, depth: Array, camera: Camera, cloud: Array, ground_m: float | None = None
) -> Array:
    """The object's pixels (H, W) bool in another camera, by what the first one saw of it.

    Args:
        colour: (H, W, 3) uint8.
        depth: (H, W) [m], 0: none.
        camera: this camera, in the world of the cloud.
        cloud: places on the object [m], (P, 3).
        ground_m: as in ``mask_in_box``.

    Raises:
        TrackingFailed: the object is outside of the picture, or nothing stands out.
    """
    pixels, distance = camera.project(cloud)
    seen = pixels[distance > 0]
    if not len(seen):
        raise TrackingFailed("the object is behind the camera")
    low, high = np.percentile(seen, 1, axis=0), np.percentile(seen, 99, axis=0)
    margin = 0.08 * np.linalg.norm(high - low) + 4
    left, top = (int(v) for v in np.floor(low - margin))
    right, bottom = (int(v) for v in np.ceil(high + margin))
    mask = mask_in_box(colour, depth, camera, Box(left, top, right, bottom), ground_m)
    extent = np.sort(np.percentile(cloud, 99, axis=0) - np.percentile(cloud, 1, axis=0))
    room = ROOM_M + ROOM_SHARE * extent[1]
    rows, columns = np.nonzero(mask & (depth > 0))
    place = back_project(camera, np.stack([columns, rows], axis=1) + 0.5, depth[rows, columns])
    low, high = np.percentile(cloud, 1, axis=0) - room, np.percentile(cloud, 99, axis=0) + room
    within = np.zeros(mask.shape, dtype=bool)
    within[rows, columns] = ((place > low) & (place < high)).all(axis=1)
    return _largest(within)


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
