"""An ArUco or AprilTag marker in the pictures: four points of it to a few hundredths of a pixel, and its plane.

A detector finds a marker's corners to a tenth of a pixel. All of its picture says far more: each sight of it is laid
flat by the corners and fitted onto one template, the mean of all of them, by the homography of the highest correlation
(Evangelidis & Psarakis 2008). So the four points are the same of the plate in every frame and every camera, wherever
the template has them. Their plane is that of the depth pixels on the marker and on the margin around it, as far as it
lies in the same plane.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.tracking.depth import flat_part, on_plane, plane_in
from physworld.tracking.view import View, from_opencv

DICTIONARIES = (
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000", "5X5_50", "5X5_100", "5X5_250", "5X5_1000", "6X6_50", "6X6_100",
    "6X6_250", "6X6_1000", "7X7_50", "7X7_100", "7X7_250", "7X7_1000", "ARUCO_ORIGINAL", "APRILTAG_36h11",
)  # fmt: skip
FLAT_PX, MARGIN_PX, COUNTED_PX = 96, 24, 10
"""Of the flat picture: the marker's side, what is around it, and how much of that counts."""
ROUNDS, STEPS, LEAST_CORRELATION = 2, 40, 0.8
AROUND = 1.25
"""Times the marker's size: where its plane is looked for, since a marker has a margin of at least a sixth."""
SLOPE_PX = 20.0
"""What slopes of 1/Z are told over."""


@dataclass(frozen=True)
class Sighted:
    """A marker in one camera's pictures.

    Attributes:
        pixels: of four of its points, (T, 4, 2), nan where it is not seen.
        planes: 1/Z [1/m] at their middle, and how it grows over ``SLOPE_PX`` along the columns and along the rows,
            (T, 3), nan where it is not seen or has no depth.
    """

    pixels: Array
    planes: Array

    @property
    def seen(self) -> Array:
        """(T,) bool."""
        known = np.isfinite(self.pixels).all(axis=(1, 2)) & np.isfinite(self.planes).all(axis=1)
        return np.asarray(known)

    def places(self, view: View) -> Array:
        """The points in space [m], (T, 4, 3), nan where not seen."""
        found = np.full((len(self.pixels), 4, 3), np.nan)
        camera = view.camera
        for frame in np.flatnonzero(self.seen):
            middle, (inverse, right, down) = self.pixels[frame].mean(axis=0), self.planes[frame]
            across, along = right / SLOPE_PX, down / SLOPE_PX
            at_centre = inverse + across * (camera.cx - middle[0]) + along * (camera.cy - middle[1])
            found[frame] = on_plane((at_centre, across, along), camera, self.pixels[frame])
        return found


def sighted(views: list[View], identity: int | None = None, dictionary: str = "4X4_50") -> list[Sighted]:
    """A marker in all cameras' pictures.

    Args:
        views: the cameras.
        identity: the marker's number; None: whichever the first camera that sees one sees first.
        dictionary: of ``DICTIONARIES``.

    Raises:
        TrackingFailed: no such dictionary, or the marker is never seen.
    """
    quads = _detected(views, identity, dictionary)
    template = None
    for _ in range(ROUNDS):
        total, count = np.zeros((FLAT_PX + 2 * MARGIN_PX,) * 2, np.float32), 0
        for view, quad in zip(views, quads, strict=True):
            for frame in _shown(quad):
                matrix, flat = _flat(view, frame, quad[frame])
                if template is not None:
                    quad[frame] = _aligned(template, flat, matrix)
                total, count = total + flat, count + 1
                if template is None:
                    template = flat
        template = total / count
    found = []
    for view, quad in zip(views, quads, strict=True):
        planes = np.full((view.frames, 3), np.nan)
        for frame in _shown(quad):
            planes[frame] = _plane(view, frame, quad[frame])
        found.append(Sighted(from_opencv(quad), planes))
    if not any(one.seen.any() for one in found):
        raise TrackingFailed(f"the marker is seen, but has depth in none of {views[0].frames} frames")
    return found


def _detected(views: list[View], identity: int | None, dictionary: str) -> list[Array]:
    """Corners in every camera's pictures, (T, 4, 2) in OpenCV's pixels, nan where it is not seen."""
    if dictionary not in DICTIONARIES:
        raise TrackingFailed(f"no dictionary {dictionary!r} of markers; known: {', '.join(DICTIONARIES)}")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}")), parameters
    )
    quads, others = [], set()
    for view in views:
        quad = np.full((view.frames, 4, 2), np.nan)
        for frame, grey in _greys(view):
            found, identities, _ = detector.detectMarkers(grey)
            numbers = [] if identities is None else [int(n) for n in np.ravel(identities)]
            others |= set(numbers)
            if identity is None and numbers:
                identity = numbers[0]
            if identity in numbers:
                quad[frame] = np.asarray(found[numbers.index(identity)], dtype=np.float64).reshape(4, 2)
        quads.append(quad)
    if all(np.isnan(quad).all() for quad in quads):
        named = "no marker" if identity is None else f"marker {identity} of {dictionary}"
        raise TrackingFailed(
            f"{named} is seen; seen were {sorted(others) or 'none'} in {views[0].frames} frames"
            + (f" of {len(views)} cameras" if len(views) > 1 else "")
        )
    return quads


def _greys(view: View) -> Iterator[tuple[int, Array]]:
    for frame in range(view.frames):
        yield frame, cv2.cvtColor(np.ascontiguousarray(view.colour(frame)), cv2.COLOR_RGB2GRAY)


def _shown(quad: Array) -> list[int]:
    """Frames in which corners (T, 4, 2) are known."""
    return [int(frame) for frame in np.flatnonzero(np.isfinite(quad).all(axis=(1, 2)))]


def _corners() -> Array:
    """Of the marker in the flat picture, (4, 2), clockwise from the upper left."""
    return MARGIN_PX + FLAT_PX * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def _flat(view: View, frame: int, quad: Array) -> tuple[Array, Array]:
    """The homography from the flat picture to the camera's, (3, 3), and the flat picture, float32."""
    matrix = cv2.getPerspectiveTransform(_corners().astype(np.float32), quad.astype(np.float32))
    grey = cv2.cvtColor(np.ascontiguousarray(view.colour(frame)), cv2.COLOR_RGB2GRAY)
    side = FLAT_PX + 2 * MARGIN_PX
    flat = cv2.warpPerspective(
        grey.astype(np.float32), matrix, (side, side), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    )
    return np.asarray(matrix, dtype=np.float64), np.asarray(flat, dtype=np.float32)


def _aligned(template: Array, flat: Array, matrix: Array) -> Array:
    """Where the template's corners are in the camera's picture, (4, 2); nan where it does not look like that."""
    counted = np.zeros(template.shape, np.uint8)
    kept = slice(MARGIN_PX - COUNTED_PX, MARGIN_PX + FLAT_PX + COUNTED_PX)
    counted[kept, kept] = 255
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, STEPS, 1e-6)
    try:
        alike, warp = cv2.findTransformECC(
            template, flat, np.eye(3, dtype=np.float32), cv2.MOTION_HOMOGRAPHY, criteria, counted, 5
        )
    except cv2.error:  # what OpenCV raises where the search does not converge
        return np.full((4, 2), np.nan)
    if alike < LEAST_CORRELATION:
        return np.full((4, 2), np.nan)
    places = np.concatenate([_corners(), np.ones((4, 1))], axis=1) @ (matrix @ warp.astype(np.float64)).T
    found: Array = places[:, :2] / places[:, 2:]
    return found


def _plane(view: View, frame: int, quad: Array) -> Array:
    """Of ``Sighted.planes``, (3,)."""
    depth, camera, middle = view.depth(frame), view.camera, quad.mean(axis=0)

    def within(size: float) -> tuple[Array, Array]:
        inside = np.zeros(depth.shape, dtype=np.uint8)
        cv2.fillConvexPoly(inside, np.round(middle + size * (quad - middle)).astype(np.int32), 1)
        rows, columns = np.nonzero(inside)
        return rows, columns

    inner = within(0.85)
    plane = plane_in(depth, camera, *inner)
    if plane is None:
        return np.full(3, np.nan)
    inverse, across, along = flat_part(depth, camera, plane, inner, within(AROUND))
    column, row = from_opencv(middle)
    return np.array(
        [
            inverse + across * (column - camera.cx) + along * (row - camera.cy),
            SLOPE_PX * across,
            SLOPE_PX * along,
        ]
    )
