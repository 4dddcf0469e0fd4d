"""The motion of what holds the object from its colour or from a robot's log.

Each gives a rigid path (:mod:`physworld.tracking.rigid`), which carries whatever points the scene shall have as
controllers. Markers are in :mod:`physworld.tracking.markers` and :mod:`physworld.tracking.poses`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.tracking.depth import on_plane, plane_in
from physworld.tracking.rigid import RigidPath, joined, without_noise
from physworld.tracking.view import View, from_opencv, to_opencv

UNIT_WITHIN = 1e-2
"""How far from 1 the length of a quaternion may be."""


def colour_middles(
    views: list[View], at: tuple[int, int], tolerance: int = 12, least_pixels: int = 20
) -> Array:
    """The middle of what has one colour, in every frame [m], (T, 3), nan where no camera sees any.

    Args:
        views: the cameras; the others look for the colour where the first one sees it.
        at: column and row of a pixel of the gripper in the first camera's first frame.
        tolerance: of the hue, of 180; of saturation and brightness five times as much.
        least_pixels: fewer are nothing.
    """
    first = cv2.cvtColor(np.ascontiguousarray(views[0].colour(0)), cv2.COLOR_RGB2HSV)
    column, row = at
    patch = first[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3].reshape(-1, 3)
    if not len(patch):
        raise TrackingFailed(
            f"the pixel {column},{row} is outside of the picture {first.shape[1]} x {first.shape[0]}"
        )
    like = _Colour(np.median(patch, axis=0), tolerance, least_pixels)
    paths = [like.middles(views[0], np.array([column, row], dtype=float))]
    known = np.flatnonzero(np.isfinite(paths[0]).all(axis=1))
    for view in views[1:]:
        if not len(known) or known[0] > 0:
            break
        pixel, distance = view.camera.project(paths[0][:1])
        if distance[0] > 0:
            paths.append(like.middles(view, to_opencv(pixel[0]).astype(float)))
    return joined([path[:, None] for path in paths])[:, 0]


@dataclass(frozen=True)
class _Colour:
    """What is looked for: hue, saturation, brightness (3,), how near, and how many pixels at least."""

    wanted: Array
    tolerance: int
    least_pixels: int

    def middles(self, view: View, place: Array) -> Array:
        """Of the part of that colour which is nearest to ``place`` [px], (2,), and to where it was in the last
        frame; (T, 3)."""
        middles = np.full((view.frames, 3), np.nan)
        for frame in range(view.frames):
            hsv = cv2.cvtColor(np.ascontiguousarray(view.colour(frame)), cv2.COLOR_RGB2HSV).astype(int)
            hue = np.abs((hsv[..., 0] - self.wanted[0] + 90) % 180 - 90)
            alike = hue <= self.tolerance
            alike &= (np.abs(hsv[..., 1:] - self.wanted[1:]) <= 5 * self.tolerance).all(axis=2)
            count, labels, facts, centres = cv2.connectedComponentsWithStats(
                alike.astype(np.uint8), connectivity=8
            )
            large = [n for n in range(1, count) if facts[n, cv2.CC_STAT_AREA] >= self.least_pixels]
            if not large:
                continue
            near = min(large, key=lambda n: float(np.linalg.norm(centres[n] - place)))
            depth = view.depth(frame)
            rows, columns = np.nonzero((labels == near) & (depth > 0))
            if len(rows) >= self.least_pixels // 2:
                plane = plane_in(depth, view.camera, rows, columns)
                place = centres[near]
                if plane is not None:
                    middles[frame] = on_plane(plane, view.camera, from_opencv(place)[None])[0]
        return middles


def translated(middles: Array) -> RigidPath:
    """A path without turns through middles (T, 3) [m], nan where there is none.

    Raises:
        TrackingFailed: there is none at all.
    """
    seen: Array = np.asarray(np.isfinite(middles).all(axis=1))
    if not seen.any():
        raise TrackingFailed(f"the gripper is seen in none of {len(middles)} frames")
    return without_noise(None, middles, seen, middles[seen][:1], 0.0)


@dataclass(frozen=True)
class LogFrame:
    """The frame of a log in the scene's world: ``x_scene = turn · x_log + place``, with place (3,) [m]."""

    turn: Rotation
    place: Array

    @classmethod
    def of_base(cls, pose: Sequence[float], turned: Array | None = None) -> LogFrame:
        """The frame of a robot's base.

        Args:
            pose: of the base in the cameras' world: x, y, z [m] and a quaternion, scalar first, of length 1.
            turned: the cameras' world in the scene's, 4 × 4; None: they are one.

        Raises:
            TrackingFailed: the quaternion's length is not 1 within a hundredth.
        """
        given = np.asarray(pose, dtype=np.float64)
        length = float(np.linalg.norm(given[3:]))
        if not abs(length - 1.0) <= UNIT_WITHIN:
            raise TrackingFailed(f"the quaternion of the robot's base has length {length:.4g}, not 1")
        turn, place = Rotation.from_quat(given[[4, 5, 6, 3]]), given[:3]
        if turned is None:
            return cls(turn, place)
        return cls(Rotation.from_matrix(turned[:3, :3]) * turn, turned[:3, :3] @ place + turned[:3, 3])


def logged(
    log_times: Array,
    places: Array,
    quaternions_wxyz: Array | None,
    times: Array,
    frame: LogFrame | None = None,
) -> RigidPath:
    """The path of a robot's log at the frames' times.

    Args:
        log_times: [s], on the clock of the frames, (L,) increasing.
        places: of the tool in the log's frame [m], (L, 3).
        quaternions_wxyz: its orientation, (L, 4), or None: it does not turn.
        times: of the frames [s], (T,).
        frame: of the log in the scene's world; None: they are one.

    Raises:
        TrackingFailed: the log does not cover the recording.
    """
    if log_times[0] > times[0] + 1e-6 or log_times[-1] < times[-1] - 1e-6:
        raise TrackingFailed(
            f"the log runs from {log_times[0]:.3f} to {log_times[-1]:.3f} s, the recording from "
            f"{times[0]:.3f} to {times[-1]:.3f} s"
        )
    there = np.stack([np.interp(times, log_times, places[:, axis]) for axis in range(3)], axis=1)
    if frame is not None:
        there = frame.turn.apply(there) + frame.place
    turns = np.zeros((len(times), 3))
    if quaternions_wxyz is not None:
        rotations = Rotation.from_quat(quaternions_wxyz[:, [1, 2, 3, 0]])
        now = Slerp(log_times, rotations)(np.clip(times, log_times[0], log_times[-1]))
        turns = (now * now[0].inv()).as_rotvec()  # about the log's axes
        if frame is not None:
            turns = frame.turn.apply(turns)
    return RigidPath(turns, there, np.ones(len(times), dtype=bool), there[:1], 0.0)
