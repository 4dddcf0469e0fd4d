"""A plane seen by one camera: where it lies, and its motion as pictures with depth.

Whoever moves in a known plane needs no depth camera: the depth of every pixel is that of the plane. So the tracker of
:mod:`physworld.tracking.points` follows such a motion as it follows one with depth, and each pixel goes to the plane by
its homography. The plane's own frame: x to the right in the picture, y up in it, z towards the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.errors import TrackingFailed
from physworld.tracking.neighbours import nearest
from physworld.tracking.view import View

TRACKING_PIXEL_M = 0.6e-3
"""What a pixel of the object spans where the tracker's tolerances, which are lengths, are of a few pixels."""
STEEPEST = 0.1
"""Least cosine between a ray and the plane's normal, below which a pixel has no place on the plane."""
LEAST_PAIRS = 6


@dataclass(frozen=True)
class Plane:
    """A plane in a camera's frame (x right, y down, z forward).

    Attributes:
        origin: a point on it [m], (3,).
        axes: rows are its x, y and z, (3, 3).
        residual_px: root mean square of what told it, where it lies by then; 0: nothing is left over.
    """

    origin: Array
    axes: Array
    residual_px: float = 0.0

    @property
    def tilt_deg(self) -> float:
        """Between the plane's normal and the camera's axis [deg]."""
        return float(np.degrees(np.arccos(np.clip(-self.axes[2, 2], -1.0, 1.0))))

    def nearer(self, distance_m: float) -> Plane:
        """The parallel plane that lies ``distance_m`` towards the camera."""
        return replace(self, origin=self.origin + distance_m * self.axes[2])

    def turned(self, start: Array, end: Array) -> Plane:
        """The same plane whose y points from ``end`` to ``start``, two places on it in the camera's frame (3,)."""
        up = self.axes @ (start - end)
        up /= np.linalg.norm(up)
        turn = np.array([[up[1], -up[0], 0.0], [up[0], up[1], 0.0], [0.0, 0.0, 1.0]])
        return replace(self, axes=turn @ self.axes)

    def at(self, camera: Camera, pixels: Array) -> Array:
        """Places (P, 3) [m] in the camera's frame of pixels (P, 2) on the plane, nan where a ray does not meet it."""
        rays = np.stack(
            [
                (pixels[:, 0] - camera.cx) / camera.fx,
                (pixels[:, 1] - camera.cy) / camera.fy,
                np.ones(len(pixels)),
            ],
            axis=1,
        )
        towards = rays @ self.axes[2]
        meets = -towards > STEEPEST * np.linalg.norm(rays, axis=1)
        depth = np.where(meets, (self.origin @ self.axes[2]) / np.where(meets, towards, 1.0), np.nan)
        places: Array = rays * depth[:, None]
        return places


def facing(origin: Array, normal: Array, residual_px: float = 0.0) -> Plane:
    """The plane through ``origin`` (3,) with ``normal`` (3,), in the camera's frame, its x to the right in the picture.

    Raises:
        TrackingFailed: it is seen edge-on.
    """
    normal = normal / np.linalg.norm(normal)
    if normal @ origin > 0:
        normal = -normal
    cosine = float(-normal @ origin / np.linalg.norm(origin))
    if cosine < STEEPEST:
        raise TrackingFailed(
            f"the plane is seen at {np.degrees(np.arccos(cosine)):.0f} degrees from its normal, "
            f"at most {np.degrees(np.arccos(STEEPEST)):.0f} are possible"
        )
    right = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    right /= np.linalg.norm(right)
    return Plane(origin, np.stack([right, np.cross(normal, right), normal]), residual_px)


def frontal(camera: Camera, pixels: Array, length_m: float) -> Plane:
    """The plane across the camera's axis in which two pixels (2, 2) lie ``length_m`` apart; its origin is the first."""
    rays = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    depth = length_m / float(np.linalg.norm(rays[1] - rays[0]))
    return Plane(np.array([*(rays[0] * depth), depth]), np.diag([1.0, -1.0, -1.0]))


def view_of(view: View, plane: Plane, turn: Array) -> View:
    """The recording with the plane's depth, in a world that is the plane's frame turned.

    Args:
        view: the recording; its camera's place and its depth are not read.
        plane: in the camera's frame.
        turn: from the plane's frame to the world, (3, 3).
    """
    camera = view.camera
    pose = np.eye(4)
    pose[:3, :3] = (turn @ plane.axes).T
    pose[:3, 3] = plane.origin
    rows, columns = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    depth = np.nan_to_num(plane.at(camera, pixels)[:, 2]).reshape(camera.height, camera.width)
    depth = depth.astype(np.float32)
    return replace(view, camera=replace(camera, world_to_camera=pose), depth=lambda frame: depth)


def scaled(view: View, factor: float) -> View:
    """The same recording in a world whose lengths are ``factor`` times as long."""
    pose = view.camera.world_to_camera.copy()
    pose[:3, 3] *= factor
    return replace(
        view,
        camera=replace(view.camera, world_to_camera=pose),
        depth=lambda frame: view.depth(frame) * np.float32(factor),
    )


def stretch(points: Array, visible: Array, neighbours: int = 6) -> Array:
    """Median ratio of the distances between neighbouring points to those of the first frame, (T,); nan: too few.

    A body that does not stretch keeps it at 1 while it bends in its plane. What comes nearer to the camera seems
    longer, by its way over its distance; what turns out of the plane seems shorter, by the cosine.

    Args:
        points: (T, N, 3) [m].
        visible: (T, N) bool.
        neighbours: of each point.
    """
    first = np.flatnonzero(visible[0])
    ratios = np.full(len(points), np.nan)
    if len(first) < 2:
        return ratios
    near = first[nearest(points[0, first], neighbours)]
    pairs = np.unique(
        np.sort(np.stack([np.repeat(first, near.shape[1]), near.ravel()], axis=1), axis=1), axis=0
    )
    start = np.linalg.norm(points[0, pairs[:, 0]] - points[0, pairs[:, 1]], axis=1)
    far = start >= np.median(start)  # the noise of short ones is large against them
    pairs, start = pairs[far], start[far]
    for frame, (now, seen) in enumerate(zip(points, visible, strict=True)):
        both = seen[pairs].all(axis=1)
        if both.sum() >= LEAST_PAIRS:
            there = pairs[both]
            lengths = np.linalg.norm(now[there[:, 0]] - now[there[:, 1]], axis=1)
            ratios[frame] = np.median(lengths / start[both])
    return ratios
