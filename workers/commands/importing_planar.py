"""What ``physworld import`` is told of a film of a motion in a plane, and the reading of one."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from physworld.scene import Scene
    from physworld.tracking.boards import Board
    from physworld.tracking.recording import Followed
    from physworld_scenes.importers import ImportOptions
    from physworld_scenes.importers.planar.place import PlaneFrom
    from physworld_scenes.importers.rgbd import PictureOptions

FORMS = (
    "charuco:COLUMNSxROWS:SQUARE:MARKER[:DICTIONARY], aruco:COLUMNSxROWS:MARKER:GAP[:DICTIONARY] or "
    "marker:NUMBER:SIDE[:DICTIONARY], lengths in metres"
)
SIZES = {"charuco": 2, "aruco": 2, "marker": 1}


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of a film."""
    parser.add_argument("--board", default=None, help=f"of a film, printed, in the plane: {FORMS}")
    parser.add_argument(
        "--scale", default=None, help="instead, two pixels and their distance: COLUMN,ROW,COLUMN,ROW,METRES"
    )
    parser.add_argument(
        "--camera", type=Path, default=None, help="JSON: width, height, fx, fy, cx, cy, distortion"
    )
    parser.add_argument("--plumb", default=None, help="line along which gravity pulls: COLUMN,ROW,COLUMN,ROW")
    parser.add_argument(
        "--before", type=float, default=None, help="how far the object is before the plane [m]"
    )


def require_film(given: argparse.Namespace, filmed: bool) -> None:
    """Raises ValueError where a plane is told of what is no film."""
    for name in ("board", "scale", "camera", "plumb", "before"):
        if getattr(given, name) is not None and not filmed:
            raise ValueError(f"--{name} is for a film or pictures of one camera, which {given.source} is not")


def read(
    given: argparse.Namespace, options: ImportOptions, pictures: PictureOptions
) -> tuple[Scene, list[str], Followed]:
    """The scene in a film, its warnings, and what was followed."""
    from physworld_scenes.importers.planar.reading import read_planar
    from physworld_workers.commands.terminal import progress_bar

    plane = _plane(given)
    with progress_bar(f"import {given.source.name}") as shown:
        return read_planar(given.source, options, pictures, plane, shown)


def numbers(option: str, text: str, count: int) -> list[float]:
    """``count`` finite numbers with commas between.

    Raises:
        ValueError: the text holds something else.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{option} takes {count} numbers with commas between, got {text!r}")
    return values


def _plane(given: argparse.Namespace) -> PlaneFrom:
    from physworld_scenes.importers.planar.place import PlaneFrom

    if (given.board is None) == (given.scale is None):
        raise ValueError("a film needs one of --board and --scale: what tells the plane and its scale")
    scale = None if given.scale is None else numbers("--scale", given.scale, 5)
    plumb = None if given.plumb is None else numbers("--plumb", given.plumb, 4)
    return PlaneFrom(
        board=None if given.board is None else board_of(given.board),
        pixels=None if scale is None else ((scale[0], scale[1]), (scale[2], scale[3])),
        length_m=None if scale is None else scale[4],
        lens=given.camera,
        plumb=None if plumb is None else ((plumb[0], plumb[1]), (plumb[2], plumb[3])),
        before_m=given.before or 0.0,
    )


def board_of(text: str) -> Board:
    """The board that a text describes.

    Raises:
        ValueError: it is not of a known form, with the forms.
    """
    from physworld.tracking.boards import Board

    form, _, rest = text.partition(":")
    parts = rest.split(":")
    try:
        lengths = [float(part) for part in parts[1 : 1 + SIZES[form]]]
        if len(lengths) != SIZES[form] or not all(0 < length < 100 for length in lengths):
            raise ValueError(lengths)
        dictionary = "".join(parts[1 + SIZES[form] :]) or Board.dictionary
        if form == "marker":
            return Board(1, 1, lengths[0], first=int(parts[0]), dictionary=dictionary)
        columns, rows = (int(part) for part in parts[0].split("x"))
        if form == "aruco":
            return Board(columns, rows, lengths[0], gap_m=lengths[1], dictionary=dictionary)
        if not (lengths[1] < lengths[0] and min(columns, rows) > 1):
            raise ValueError(lengths)
        return Board(columns, rows, lengths[1], square_m=lengths[0], dictionary=dictionary)
    except (KeyError, ValueError) as error:
        raise ValueError(f"--board {text!r} is none of {FORMS}") from error
