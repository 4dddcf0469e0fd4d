"""What the tracker looks at: calibrated cameras with colour and depth, one frame at a time.

Pixel coordinates follow :mod:`physworld.camera`: pixel centres lie at half-integers. OpenCV's functions put them at
integers; ``to_opencv`` and ``from_opencv`` are half a pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.errors import TrackingFailed


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


@dataclass(frozen=True)
class View:
    """One camera's recording.

    Attributes:
        camera: pinhole, in the world that the tracks shall be in.
        colour: frame number to colours (H, W, 3) uint8, red first.
        depth: frame number to depth along the axis (H, W) float32 [m], 0 where there is none.
        frames: T.
    """

    camera: Camera
    colour: Callable[[int], Array]
    depth: Callable[[int], Array]
    frames: int


def back_project(camera: Camera, pixels: Array, depth: Array) -> Array:
    """Places in the world [m], (P, 3).

    Args:
        camera: pinhole.
        pixels: (P, 2).
        depth: along the camera's axis [m], (P,).
    """
    rays = np.stack(
        [
            (pixels[:, 0] - camera.cx) / camera.fx,
            (pixels[:, 1] - camera.cy) / camera.fy,
            np.ones(len(pixels)),
        ],
        axis=1,
    )
    local = rays * np.asarray(depth)[:, None] - camera.world_to_camera[:3, 3]
    world: Array = local @ camera.world_to_camera[:3, :3]
    return world


def cloud_of(camera: Camera, depth: Array, mask: Array) -> tuple[Array, Array]:
    """Places (P, 3) [m] of the pixels of a mask that have depth, and their rows and columns (P, 2).

    Args:
        camera: pinhole.
        depth: (H, W) [m].
        mask: (H, W) bool.
    """
    rows, columns = np.nonzero(mask & (depth > 0))
    pixels = np.stack([columns, rows], axis=1) + 0.5
    return back_project(camera, pixels, depth[rows, columns]), np.stack([rows, columns], axis=1)


def to_opencv(pixels: Array) -> Array:
    """The same places as OpenCV counts them, float32."""
    return np.asarray(pixels - 0.5, dtype=np.float32)


def from_opencv(pixels: Array) -> Array:
    """The other way, float64."""
    return np.asarray(pixels, dtype=np.float64) + 0.5
