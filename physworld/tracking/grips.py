"""The motion of what holds the object: from a marker on the gripper, a picked patch of it, its colour, or a
robot's log.

Each gives a rigid path, rotation and shift of the gripper at every frame since the first one, and the path carries
whatever points the scene shall have as controllers. A marker's corners are found to a fraction of a pixel; their
depth is that of the plane through all depth pixels of the marker, which is far better than that of any pixel.
Where a gripper is not seen, its path is interpolated, and the scene says how often.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation, Slerp

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.tracking.depth import on_plane, plane_in
from physworld.tracking.view import View, from_opencv, to_opencv

SMOOTHED_FRAMES = 5
"""Of the Savitzky-Golay filter, of order 2: it leaves a constant acceleration as it is."""
DICTIONARIES = (
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000", "5X5_50", "5X5_100", "5X5_250", "5X5_1000", "6X6_50", "6X6_100",
    "6X6_250", "6X6_1000", "7X7_50", "7X7_100", "7X7_250", "7X7_1000", "ARUCO_ORIGINAL", "APRILTAG_36h11",
)  # fmt: skip


@dataclass(frozen=True)
class RigidPath:
    """A gripper's motion.

    Attributes:
        turns: rotation vectors since the first frame, (T, 3) [rad].
        places: of its middle [m], (T, 3).
        seen: whether it was seen, (T,) bool; elsewhere it is interpolated.
        reference: points on it at the first frame [m], (Q, 3).
        misfit_m: deviation of its points from a rigid motion.
    """

    turns: Array
    places: Array
    seen: Array
    reference: Array
    misfit_m: float

    def carry(self, points: Array) -> Array:
        """Points (K, 3) [m] of the first frame at every frame, (T, K, 3)."""
        matrices = Rotation.from_rotvec(self.turns).as_matrix()
        carried: Array = np.einsum("tij,kj->tki", matrices, points - self.places[0]) + self.places[:, None]
        return carried


def marker_corners(views: list[View], identity: int | None = None, dictionary: str = "4X4_50") -> Array:
    """Corners of an ArUco or AprilTag marker in every frame [m], (T, 4, 3), nan where no camera sees it.

    Args:
        views: the cameras.
        identity: the marker's number; None: whichever the first camera that sees one sees first.
        dictionary: of ``DICTIONARIES``.

    Raises:
        TrackingFailed: no such dictionary, or the marker is never seen.
    """
    if dictionary not in DICTIONARIES:
        raise TrackingFailed(f"no dictionary {dictionary!r} of markers; known: {', '.join(DICTIONARIES)}")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}")), parameters
    )
    paths, seen_of = [], set()
    for view in views:
        corners = np.full((view.frames, 4, 3), np.nan)
        for frame in range(view.frames):
            grey = cv2.cvtColor(np.ascontiguousarray(view.colour(frame)), cv2.COLOR_RGB2GRAY)
            found, identities, _ = detector.detectMarkers(grey)
            numbers = [] if identities is None else [int(n) for n in np.ravel(identities)]
            seen_of |= set(numbers)
            if identity is None and numbers:
                identity = numbers[0]
            if identity in numbers:
                quad = np.asarray(found[numbers.index(identity)], dtype=np.float64).reshape(4, 2)
                corners[frame] = _in_space(view, frame, quad)
        paths.append(corners)
    if np.isnan(paths).all():
        named = "no marker" if identity is None else f"marker {identity} of {dictionary}"
        raise TrackingFailed(
            f"{named} is seen; seen were {sorted(seen_of) or 'none'} in {views[0].frames} frames"
            + (f" of {len(views)} cameras" if len(views) > 1 else "")
        )
    return joined(paths)


def _in_space(view: View, frame: int, quad: Array) -> Array:
    """Corners (4, 3) [m] of a marker seen at ``quad`` (4, 2) in OpenCV's pixels; nan without depth."""
    depth = view.depth(frame)
    inside = np.zeros(depth.shape, dtype=np.uint8)
    cv2.fillConvexPoly(inside, np.round(quad).astype(np.int32), 1)
    rows, columns = np.nonzero(cv2.erode(inside, np.ones((3, 3), np.uint8)))
    plane = plane_in(depth, view.camera, rows, columns)
    return np.full((4, 3), np.nan) if plane is None else on_plane(plane, view.camera, from_opencv(quad))


def rigid_path(points: Array, smoothed_frames: int = SMOOTHED_FRAMES) -> RigidPath:
    """The rigid motion of points (T, Q, 3) [m] that move together, nan where one is not seen.

    The shape is the mean of all frames, laid onto one another; then each frame's turn and place are those that fit it.

    Raises:
        TrackingFailed: in no frame are three points seen, or they are not in the first.
    """
    known: Array = np.asarray(np.isfinite(points).all(axis=2))
    seen: Array = np.asarray(known.sum(axis=1) >= 3)
    if not seen.any():
        raise TrackingFailed(f"three points of the gripper are seen in none of {len(points)} frames")
    first = int(np.argmax(seen))
    shape = np.where(known[first][:, None], points[first], np.nan)
    for _ in range(3):
        back = np.full(points.shape, np.nan)
        for frame in np.flatnonzero(seen):
            both = known[frame] & np.isfinite(shape).all(axis=1)
            if both.sum() >= 3:
                turn, shift = kabsch(points[frame, both], shape[both])
                back[frame] = points[frame] @ turn.T + shift
        with np.errstate(invalid="ignore"):
            count = np.isfinite(back).all(axis=2).sum(axis=0)
            shape = np.where(
                count[:, None] > 0, np.nansum(back, axis=0) / np.maximum(count, 1)[:, None], np.nan
            )
    usable = np.isfinite(shape).all(axis=1)
    middle = shape[usable].mean(axis=0)
    turns, places = np.zeros((len(points), 3)), np.zeros((len(points), 3))
    misfit = []
    for frame in np.flatnonzero(seen):
        both = known[frame] & usable
        seen[frame] = both.sum() >= 3
        if not seen[frame]:
            continue
        turn, shift = kabsch(shape[both], points[frame, both])
        turns[frame], places[frame] = Rotation.from_matrix(turn).as_rotvec(), turn @ middle + shift
        misfit.append(points[frame, both] - shape[both] @ turn.T - shift)
    turns, places = _between(turns, places, seen)
    turns, places = _smoothed(turns, places, smoothed_frames)
    start = Rotation.from_rotvec(turns[0])
    reference = (shape[usable] - middle) @ start.as_matrix().T + places[0]
    relative = (Rotation.from_rotvec(turns) * start.inv()).as_rotvec()
    return RigidPath(relative, places, seen, reference, float(np.std(np.concatenate(misfit))))


def joined(paths: list[Array]) -> Array:
    """One path (T, Q, 3) of points that several cameras see, nan where none does.

    Cameras that are calibrated a little differently put the same points a little apart: without these shifts, which
    are those of the frames that a camera shares with the one that sees most, the path does not jump where one loses
    sight. The mean of the shifts stays.

    Args:
        paths: of each camera [m], (T, Q, 3), nan where it does not see them.
    """
    stacked = np.stack(paths)
    known: Array = np.asarray(np.isfinite(stacked).all(axis=(2, 3)))
    most = int(np.argmax(known.sum(axis=1)))
    shared = known & known[most]
    shifts = [
        np.median((path - paths[most])[both].mean(axis=1), axis=0) if both.any() else np.full(3, np.nan)
        for path, both in zip(paths, shared, strict=True)
    ]
    told: Array = np.asarray(np.isfinite(np.stack(shifts)).all(axis=1))
    shift = np.where(told[:, None], np.stack(shifts) - np.stack(shifts)[told].mean(axis=0), 0.0)
    count = known.sum(axis=0)
    total = np.where(known[..., None, None], stacked - shift[:, None, None], 0.0).sum(axis=0)
    return np.where(count[:, None, None] > 0, total / np.maximum(count, 1)[:, None, None], np.nan)


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


def translated(middles: Array, smoothed_frames: int = SMOOTHED_FRAMES) -> RigidPath:
    """A path without turns through middles (T, 3) [m], nan where there is none.

    Raises:
        TrackingFailed: there is none at all.
    """
    seen: Array = np.asarray(np.isfinite(middles).all(axis=1))
    if not seen.any():
        raise TrackingFailed(f"the gripper is seen in none of {len(middles)} frames")
    none = np.zeros((len(middles), 3))
    _, places = _between(none, np.where(seen[:, None], middles, 0.0), seen)
    _, places = _smoothed(none, places, smoothed_frames)
    return RigidPath(none, places, seen, places[:1], 0.0)


def logged(log_times: Array, places: Array, quaternions_wxyz: Array | None, times: Array) -> RigidPath:
    """The path of a robot's log at the frames' times.

    Args:
        log_times: [s], on the clock of the frames, (L,) increasing.
        places: of the tool in the scene's world [m], (L, 3).
        quaternions_wxyz: its orientation, (L, 4), or None: it does not turn.
        times: of the frames [s], (T,).

    Raises:
        TrackingFailed: the log does not cover the recording.
    """
    if log_times[0] > times[0] + 1e-6 or log_times[-1] < times[-1] - 1e-6:
        raise TrackingFailed(
            f"the log runs from {log_times[0]:.3f} to {log_times[-1]:.3f} s, the recording from "
            f"{times[0]:.3f} to {times[-1]:.3f} s"
        )
    there = np.stack([np.interp(times, log_times, places[:, axis]) for axis in range(3)], axis=1)
    turns = np.zeros((len(times), 3))
    if quaternions_wxyz is not None:
        rotations = Rotation.from_quat(quaternions_wxyz[:, [1, 2, 3, 0]])
        now = Slerp(log_times, rotations)(np.clip(times, log_times[0], log_times[-1]))
        turns = (now * now[0].inv()).as_rotvec()
    return RigidPath(turns, there, np.ones(len(times), dtype=bool), there[:1], 0.0)


def kabsch(start: Array, end: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) and shift (3,) that lay points (Q, 3) onto others best: end = turn @ start + shift."""
    middle_from, middle_to = start.mean(axis=0), end.mean(axis=0)
    left, _, right = np.linalg.svd((end - middle_to).T @ (start - middle_from))
    left[:, 2] *= np.sign(np.linalg.det(left @ right))
    turn = left @ right
    return turn, middle_to - turn @ middle_from


def _between(turns: Array, places: Array, seen: Array) -> tuple[Array, Array]:
    """Both with what is not seen interpolated, held at the ends."""
    frames, known = np.arange(len(seen)), np.flatnonzero(seen)
    there = np.stack([np.interp(frames, known, places[known, axis]) for axis in range(3)], axis=1)
    if len(known) < 2:
        return np.repeat(turns[known[:1]], len(seen), axis=0), there
    between = Slerp(known, Rotation.from_rotvec(turns[known]))
    return between(np.clip(frames, known[0], known[-1])).as_rotvec(), there


def _smoothed(turns: Array, places: Array, frames: int) -> tuple[Array, Array]:
    """Both through the filter; turns by the vectors between neighbouring frames' mean, which has no seam at pi."""
    if frames < 3 or len(places) < frames:
        return turns, places
    places = savgol_filter(places, frames, 2, axis=0)
    quaternions = Rotation.from_rotvec(turns).as_quat()
    for frame in range(1, len(quaternions)):
        if quaternions[frame] @ quaternions[frame - 1] < 0:
            quaternions[frame] *= -1.0
    smooth = savgol_filter(quaternions, frames, 2, axis=0)
    return Rotation.from_quat(smooth).as_rotvec(), places
