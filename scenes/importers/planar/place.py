"""Where the plane lies in the pictures, which way is up on it, and where the object is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.tracking.boards import Board, find_board
from physworld.tracking.mask import mask_in_box
from physworld.tracking.plane import Plane, frontal, view_of
from physworld.tracking.view import Box, View
from physworld_scenes.errors import refused
from physworld_scenes.importers.axes import ROTATION_FROM_UP
from physworld_scenes.importers.film import Filmed
from physworld_scenes.importers.rgbd import PictureOptions, mask_file

LEAST_APART_PX = 10.0
"""Between the two pixels of a length."""
LEAST_SPAN_M, MOST_SPAN_M = 1e-3, 20.0
RESIDUAL_WARNING_PX = 1.0
UP = "y"


@dataclass(frozen=True)
class PlaneFrom:
    """What tells the plane; a board or a length.

    Attributes:
        board: printed, in the plane, seen by the camera.
        pixels: two of the first picture (column, row), whose plane is across the camera's axis.
        length_m: between them.
        lens: JSON of the camera (:func:`physworld_scenes.importers.film.read_film`), or None.
        plumb: two pixels (column, row) of a line in the plane, along which gravity pulls; None: the axis ``up``.
        before_m: how far the object moves before that plane, towards the camera.
    """

    board: Board | None = None
    pixels: tuple[tuple[float, float], tuple[float, float]] | None = None
    length_m: float | None = None
    lens: Path | None = None
    plumb: tuple[tuple[float, float], tuple[float, float]] | None = None
    before_m: float = 0.0


@dataclass(frozen=True)
class Placed:
    """A recording on its plane.

    Attributes:
        view: with the plane's depth, in the scene's world.
        plane: in the camera's frame.
        axes: of the plane in the world: rows are x, y and z, which is towards the camera, (3, 3).
        up: which of them points up.
        facts: for the notes.
    """

    view: View
    plane: Plane
    axes: Array
    up: str
    facts: dict[str, Any]

    def places(self, pixels: Array) -> Array:
        """In the world (..., 3) [m], of pixels (..., 2)."""
        there = self.plane.at(self.view.camera, pixels.reshape(-1, 2)) - self.plane.origin
        places: Array = (there @ self.plane.axes.T @ self.axes).reshape(*pixels.shape[:-1], 3)
        return places

    def pixel_m(self, mask: Array) -> float:
        """What a pixel across the camera's axis spans at the middle of a mask (H, W) [m]."""
        depth = self.view.depth(0)[mask]
        return float(np.median(depth)) / float(np.sqrt(self.view.camera.fx * self.view.camera.fy))

    @property
    def distance_m(self) -> float:
        """Of the plane's origin from the camera, along its axis [m]."""
        return float(self.plane.origin[2])


def placed_on(filmed: Filmed, told: PlaneFrom, up: str | None, warnings: list[str]) -> Placed:
    """The recording on the plane that a board or a length tells.

    Args:
        filmed: the recording.
        told: what tells the plane.
        up: which of the plane's axes points up; None: y, which is said in the warnings.
        warnings: what was guessed is added.

    Raises:
        SceneInvalid: neither or both tell the plane, the length is too short, or up is no axis.
        TrackingFailed: the board is not found or moves.
    """
    view = filmed.view
    focal = "given" if filmed.lens_known else "taken as usual"
    facts: dict[str, Any] = {}
    if (told.board is None) == (told.pixels is None or told.length_m is None):
        raise refused(
            "plane", "what tells the plane? Either a board in it, or two of its pixels and their distance"
        )
    if told.board is not None:
        seen = find_board(view, told.board, filmed.lens_known)
        view, plane = replace(view, camera=seen.camera), seen.plane
        focal = focal if filmed.lens_known else "found with the board"
        facts = {"board_frames": list(seen.frames), "board_drift_px": round(seen.drift_px, 3)}
        if seen.frames[0] < 0.5 * seen.frames[1]:
            warnings.append(f"the {told.board} is found in {seen.frames[0]} of {seen.frames[1]} frames only")
        if plane.residual_px > RESIDUAL_WARNING_PX:
            warnings.append(
                f"the corners of the {told.board} lie {plane.residual_px:.2g} px (rms) from where a flat board of this "
                "size has them: is its declaration right, is it flat, is the lens without distortion?"
            )
    else:
        assert told.pixels is not None and told.length_m is not None
        picks = filmed.straight(np.array(told.pixels, dtype=np.float64) + 0.5)
        apart = float(np.linalg.norm(picks[1] - picks[0]))
        if apart < LEAST_APART_PX or not told.length_m > 0:
            raise refused(
                "length",
                f"{told.length_m:g} m between pixels {apart:.1f} px apart; {LEAST_APART_PX:g} px and more "
                "than 0 m are needed",
            )
        plane = frontal(view.camera, picks, told.length_m)
        warnings.append("the plane is taken to lie across the camera's axis: a length does not tell its tilt")
    plane = plane.nearer(told.before_m)
    if told.before_m and not filmed.lens_known:
        warnings.append(
            f"how far the object moves before the plane counts against the camera's distance, {plane.origin[2]:.3g} m "
            f"by a focal length of {view.camera.fx:.0f} px that is {focal}; --camera gives it"
        )
    if up is not None and (up not in ROTATION_FROM_UP or told.plumb is not None):
        raise refused("up", f"{up!r}; known: {', '.join(ROTATION_FROM_UP)}, or a plumb line instead")
    if told.plumb is not None:
        ends = plane.at(view.camera, filmed.straight(np.array(told.plumb, dtype=np.float64) + 0.5))
        if not np.linalg.norm(ends[0] - ends[1]) > 0:
            raise refused("plumb", f"the two pixels {told.plumb} tell no direction on the plane")
        plane = plane.turned(ends[0], ends[1])
    elif up is None:
        warnings.append("up is taken to be up in the picture; --up z of a table seen from above, or --plumb")
    facts |= {
        "before_m": told.before_m, "tilt_deg": round(plane.tilt_deg, 2), "residual_px": round(plane.residual_px, 3),
        "distance_m": round(float(plane.origin[2]), 6), "focal_px": round(view.camera.fx, 1), "focal": focal,
    }  # fmt: skip
    axis = up or UP
    turn = ROTATION_FROM_UP[axis]
    return Placed(view_of(view, plane, turn), plane, turn.T, axis, facts)


def mask_of(filmed: Filmed, placed: Placed, given: PictureOptions) -> Array:
    """The object in the first picture (H, W) bool."""
    view = placed.view
    if others := sorted({*given.boxes, *given.masks} - {0}):
        raise refused("box", f"is of camera {others[0]}; a film has camera 0 alone")
    mask, box = mask_file(given.masks.get(0), view.camera), given.boxes.get(0)
    if mask is None:
        if box is None:
            raise TrackingFailed("where is the object? Give a box or a mask in the first frame")
        flat = np.full((view.camera.height, view.camera.width), placed.distance_m)
        mask = mask_in_box(filmed.first, flat, view.camera, box)
    mask = filmed.straight_mask(mask)
    on_plane: Array = mask & (view.depth(0) > 0)
    if not on_plane.any():
        raise TrackingFailed(f"none of the object's {int(mask.sum())} pixels meets the plane")
    return on_plane


def straight_box(filmed: Filmed, box: Box) -> Box:
    """A box drawn on a picture as it was taken, around the same in the picture without distortion."""
    corners = np.array(
        [[x, y] for x in (box.left, box.right) for y in (box.top, box.bottom)], dtype=np.float64
    )
    moved = filmed.straight(corners)
    low, high = np.floor(moved.min(axis=0)), np.ceil(moved.max(axis=0))
    return Box(int(low[0]), int(low[1]), int(high[0]), int(high[1]))


def require_plausible(placed: Placed, mask: Array, told: PlaneFrom) -> None:
    """Raises SceneInvalid where the scale makes a mote or a house of the object."""
    rows, columns = np.nonzero(mask)
    span_px = float(np.hypot(np.ptp(rows) + 1, np.ptp(columns) + 1))
    span_m = span_px * placed.pixel_m(mask)
    if not LEAST_SPAN_M <= span_m <= MOST_SPAN_M:
        said = f"{told.length_m:g} m between the two pixels" if told.board is None else f"the {told.board}"
        raise refused(
            "scale",
            f"{said} makes {span_m:.3g} m of the object's {span_px:.0f} px; "
            f"{LEAST_SPAN_M:g} to {MOST_SPAN_M:g} m are possible",
        )
