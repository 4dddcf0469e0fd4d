"""Boards of known size in the pictures: they tell the plane that they lie in, and its scale.

ChArUco boards and grids of ArUco markers, found by OpenCV. The camera and the board stand still, so each corner's place
is the median of the frames that show it; a corner that moves says that one of the two does not stand still. The pose
is that of the least reprojection (IPPE, then Levenberg-Marquardt). A focal length that nobody knows is found along
with it: a board that is seen at an angle tells it, and where one is seen straight on, the plane hardly depends on it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import minimize_scalar

from physworld.arrays import Array
from physworld.camera import USUAL_FOCAL, Camera
from physworld.errors import TrackingFailed
from physworld.tracking.markers import DICTIONARIES
from physworld.tracking.plane import Plane, facing
from physworld.tracking.view import View, from_opencv

MOST_LOOKED_AT = 60
"""Frames, spread over the recording."""
LEAST_CORNERS = 4
FOCAL_SPREAD = 0.4
"""Of the logarithm of focal lengths of cameras in use."""
CORNER_PX = 0.3
"""How well a corner is found."""
MOST_DRIFT_PX = 3.0

Finder = Callable[[Array], tuple[Array, Array, set[int]]]


@dataclass(frozen=True)
class Board:
    """What is printed on it.

    Attributes:
        columns, rows: of squares (ChArUco) or of markers.
        marker_m: side of a marker.
        square_m: of a ChArUco board; None: a grid of markers alone.
        gap_m: between the markers of a grid.
        first: number of the first marker of a grid.
        dictionary: of ``physworld.tracking.grips.DICTIONARIES``.
    """

    columns: int
    rows: int
    marker_m: float
    square_m: float | None = None
    gap_m: float = 0.0
    first: int = 0
    dictionary: str = "4X4_50"

    def __str__(self) -> str:
        form = "markers" if self.square_m is None else "squares"
        return f"board of {self.columns} x {self.rows} {form} of {self.dictionary}"


@dataclass(frozen=True)
class BoardSeen:
    """A board in the pictures.

    Attributes:
        plane: in the camera's frame.
        camera: with the focal length that was found, or the given one.
        frames: in which it was found, and how many were looked at.
        drift_px: the farthest that all its corners together move from their medians.
    """

    plane: Plane
    camera: Camera
    frames: tuple[int, int]
    drift_px: float


def find_board(view: View, board: Board, focal_known: bool) -> BoardSeen:
    """The plane of a board.

    Args:
        view: the recording.
        board: what to look for.
        focal_known: whether the camera's focal length is to be believed.

    Raises:
        TrackingFailed: no such dictionary, the board is not found, or it moves; with the numbers.
    """
    looked = np.unique(np.linspace(0, view.frames - 1, min(view.frames, MOST_LOOKED_AT)).astype(int))
    find = _finder(board)
    places: dict[tuple[float, ...], list[tuple[int, Array]]] = {}
    others: set[int] = set()
    found = 0
    for frame in looked:
        grey = cv2.cvtColor(np.ascontiguousarray(view.colour(int(frame))), cv2.COLOR_RGB2GRAY)
        corners, pixels, numbers = find(grey)
        others |= numbers
        found += len(corners) > 0
        for corner, pixel in zip(corners, pixels, strict=True):
            places.setdefault(tuple(np.round(corner[:2], 9)), []).append((int(frame), pixel))
    if len(places) < LEAST_CORNERS:
        raise TrackingFailed(
            f"no {board} is found in {len(looked) - found} of {len(looked)} frames that were looked at, and "
            f"{len(places)} of its corners in all, {LEAST_CORNERS} are needed; "
            f"markers seen of that dictionary: {sorted(others) or 'none'}"
        )
    corners = np.array([(*corner, 0.0) for corner in places])
    medians = np.array([np.median([pixel for _, pixel in seen], axis=0) for seen in places.values()])
    drift = _drift(list(places.values()), medians)
    if drift > MOST_DRIFT_PX:
        raise TrackingFailed(
            f"the board moves by up to {drift:.1f} px, at most {MOST_DRIFT_PX:g} are allowed: "
            "camera and board must stand still"
        )
    camera = view.camera if focal_known else _with_focal(view.camera, corners, medians)
    return BoardSeen(_pose(camera, corners, medians), camera, (found, len(looked)), drift)


def _finder(board: Board) -> Finder:
    """A function from a grey picture to corners (K, 3) [m], their pixels (K, 2), and the numbers of markers seen."""
    if board.dictionary not in DICTIONARIES:
        raise TrackingFailed(
            f"no dictionary {board.dictionary!r} of markers; known: {', '.join(DICTIONARIES)}"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    size = (board.columns, board.rows)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    if board.square_m is not None:
        printed = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary)
        charuco = cv2.aruco.CharucoDetector(printed, cv2.aruco.CharucoParameters(), parameters)

        def squares(grey: Array) -> tuple[Array, Array, set[int]]:
            pixels, numbers, _, markers = charuco.detectBoard(grey)
            seen = set() if markers is None else {int(n) for n in np.ravel(markers)}
            if numbers is None or not len(numbers):
                return np.zeros((0, 3)), np.zeros((0, 2)), seen
            corners = np.asarray(printed.getChessboardCorners())[np.ravel(numbers)]
            return corners, from_opencv(np.reshape(pixels, (-1, 2))), seen

        return squares
    numbers = np.arange(board.first, board.first + board.columns * board.rows)
    grid = cv2.aruco.GridBoard(size, board.marker_m, board.gap_m or board.marker_m, dictionary, numbers)
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def markers(grey: Array) -> tuple[Array, Array, set[int]]:
        quads, found, _ = detector.detectMarkers(grey)
        seen = set() if found is None else {int(n) for n in np.ravel(found)}
        if not seen & set(numbers.tolist()):
            return np.zeros((0, 3)), np.zeros((0, 2)), seen
        corners, pixels = grid.matchImagePoints(quads, found)
        return np.reshape(corners, (-1, 3)), from_opencv(np.reshape(pixels, (-1, 2))), seen

    return markers


def _drift(seen: list[list[tuple[int, Array]]], medians: Array) -> float:
    """The farthest that the corners of a frame together lie from their medians [px]."""
    off: dict[int, list[Array]] = {}
    for places, median in zip(seen, medians, strict=True):
        for frame, pixel in places:
            off.setdefault(frame, []).append(pixel - median)
    together = [np.median(moved, axis=0) for moved in off.values() if len(moved) >= LEAST_CORNERS]
    return max((float(np.linalg.norm(shift)) for shift in together), default=0.0)


def _pose(camera: Camera, corners: Array, pixels: Array) -> Plane:
    """The plane of corners (K, 3) [m] that are seen at pixels (K, 2). Raises TrackingFailed."""
    lens = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    # IPPE wants its points around the origin
    middle = corners.mean(axis=0)
    solved, turn, shift = cv2.solvePnP(corners - middle, pixels, lens, None, flags=cv2.SOLVEPNP_IPPE)
    if not solved:
        raise TrackingFailed(f"the {len(corners)} corners of the board that are found tell no plane")
    turn, shift = cv2.solvePnPRefineLM(corners - middle, pixels, lens, None, turn, shift)
    projected, _ = cv2.projectPoints(corners - middle, turn, shift, lens, None)
    residual = float(np.sqrt(np.mean(np.sum((projected[:, 0] - pixels) ** 2, axis=1))))
    matrix = cv2.Rodrigues(turn)[0]
    return facing(shift.ravel() - matrix @ middle, matrix[:, 2], residual)


def _with_focal(camera: Camera, corners: Array, pixels: Array) -> Camera:
    """The camera with the focal length that fits best, held by what is usual where the corners do not tell."""
    usual = USUAL_FOCAL * max(camera.width, camera.height)

    def cost(logarithm: float) -> float:
        tried = replace(camera, fx=usual * np.exp(logarithm), fy=usual * np.exp(logarithm))
        misfit = len(corners) * (_pose(tried, corners, pixels).residual_px / CORNER_PX) ** 2
        return float(misfit + (logarithm / FOCAL_SPREAD) ** 2)

    best = float(minimize_scalar(cost, bounds=(-1.2, 1.8), method="bounded").x)
    return replace(camera, fx=usual * np.exp(best), fy=usual * np.exp(best))
