"""What a file of marker tracks holds, whatever its form: the same for every importer of this folder."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from physworld.arrays import Array
from physworld_scenes.errors import SceneInvalid
from physworld_schemas.base import FieldError

MOST_MARKERS = 10_000
MOST_VALUES = 16_000_000
"""Coordinates of one recording: 128 MiB of doubles."""
MOST_LABEL_CHARACTERS = 128
FARTHEST = 1e9
"""In the file's unit; what is farther away is no place."""
NAMED_AT_MOST = 8

METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}
UNIT_OF_WORD = {
    "m": "m", "meter": "m", "meters": "m", "metre": "m", "metres": "m",
    "cm": "cm", "centimeter": "cm", "centimeters": "cm", "centimetre": "cm", "centimetres": "cm",
    "mm": "mm", "millimeter": "mm", "millimeters": "mm", "millimetre": "mm", "millimetres": "mm",
    "in": "in", "inch": "in", "inches": "in", "ft": "ft", "foot": "ft", "feet": "ft",
}  # fmt: skip

UNLABELLED = re.compile(
    r"^(\*\s?\d+|(unlabell?ed|unidentified|unassigned|discarded)[ _\-.:]*\d*|new[ _]\d+)(#\d+)?$",
    re.IGNORECASE,
)
"""Labels that programs give to what nobody named: Motive, QTM, Nexus, and C3D files of theirs."""


@dataclass(frozen=True)
class RigidBody:
    """A body that the recording program followed as rigid.

    Attributes:
        name: of the body.
        places: of its origin, in the file's unit and axes, (T, 3).
        quaternions_wxyz: its orientation, (T, 4), or None.
        seen: whether it was tracked, (T,) bool.
    """

    name: str
    places: Array
    quaternions_wxyz: Array | None
    seen: Array


@dataclass(frozen=True)
class MarkerTable:
    """The tracks in a file, nothing turned, scaled or chosen yet.

    Attributes:
        form: of the file, for people.
        labels: of the markers, each once.
        places: in the file's unit and axes, (T, N, 3); meaningless where not seen.
        seen: (T, N) bool.
        times: seconds, (T,), increasing; None: the file has none.
        frames: without times: the numbers of the frames, (T,), increasing; None: one after another.
        rate_hz: frames per second that the file says, or None.
        unit: a key of ``METRES_PER_UNIT`` that the file says or its form implies, or None; ``unit_from`` says which.
        up: axis that points up, by the file or the convention of its form, or None; ``up_from`` says which.
        sets: names of groups that the file has (rigid bodies, subjects), with their labels.
        bodies: rigid bodies with their poses.
        lines: what was left out in reading, for people.
    """

    form: str
    labels: tuple[str, ...]
    places: Array
    seen: Array
    times: Array | None = None
    frames: Array | None = None
    rate_hz: float | None = None
    unit: str | None = None
    unit_from: str = "the file says so"
    up: str | None = None
    up_from: str = "the file says so"
    sets: dict[str, tuple[str, ...]] = field(default_factory=dict)
    bodies: tuple[RigidBody, ...] = ()
    lines: tuple[str, ...] = ()


def refused(where: str, message: str) -> SceneInvalid:
    """The error of one fault."""
    return SceneInvalid([FieldError(loc=[where], msg=message)])


def named(labels: list[str] | tuple[str, ...]) -> str:
    """Some labels for a sentence."""
    shown = ", ".join(shortened(label) for label in labels[:NAMED_AT_MOST])
    return shown if len(labels) <= NAMED_AT_MOST else f"{shown}, … ({len(labels)} in all)"


def shortened(text: str, most: int = 40) -> str:
    """Foreign text that is safe and short enough for a message of one line."""
    clean = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    return clean if len(clean) <= most else f"{clean[: most - 1]}…"


def unit_of(word: str, where: str) -> str:
    """The unit that a word means. Raises SceneInvalid."""
    unit = UNIT_OF_WORD.get(word.strip().lower())
    if unit is None:
        raise refused(
            where, f"the unit is {shortened(word)!r}; known are {', '.join(METRES_PER_UNIT)} and their names"
        )
    return unit


def checked_size(where: str, frames: int, markers: int) -> None:
    """Refuse a recording that nobody means, before room is made for it. Raises SceneInvalid."""
    if markers > MOST_MARKERS:
        raise refused(where, f"has {markers} markers, at most {MOST_MARKERS} are read")
    if frames * markers * 3 > MOST_VALUES:
        values = frames * markers * 3
        raise refused(
            where,
            f"{frames} frames of {markers} markers are {values} coordinates, at most {MOST_VALUES} are read",
        )


def checked_labels(where: str, labels: list[str]) -> tuple[str, ...]:
    """Labels that name one marker each; unlabelled ones of one name are numbered. Raises SceneInvalid."""
    first: dict[str, int] = {}
    found: list[str] = []
    for index, label in enumerate(labels):
        name = " ".join(label.split())[:MOST_LABEL_CHARACTERS]
        if not name:
            raise refused(where, f"marker {index + 1} of {len(labels)} has no name")
        if name in first and UNLABELLED.match(name):
            name = f"{name}#{index}"
        if name in first:
            raise refused(
                where,
                f"two markers are called {shortened(name)!r}: {first[name] + 1} and {index + 1} of {len(labels)}",
            )
        first[name] = index
        found.append(name)
    return tuple(found)


def checked_places(where: str, labels: tuple[str, ...], places: Array) -> tuple[Array, Array, list[str]]:
    """Places (T, N, 3) with zeros where there are none, where they are seen (T, N), and lines about what is not.

    Not finite: not seen. Exactly (0, 0, 0) in some frames of a marker: not seen there, as several programs write it.

    Raises:
        SceneInvalid: a value is too large for a place.
    """
    seen: Array = np.asarray(np.isfinite(places).all(axis=2))
    if not seen.all():
        places = np.where(seen[..., None], places, 0.0)
    largest = np.zeros(seen.shape)
    for row, frame in zip(largest, places, strict=True):
        np.abs(frame).max(axis=1, initial=0.0, out=row)
    if (largest > FARTHEST).any():
        frame, marker = np.argwhere(largest > FARTHEST)[0]
        raise refused(
            where,
            f"{shortened(labels[marker])} is at {largest[frame, marker]:.3g} in frame {frame}, beyond {FARTHEST:g}",
        )
    lines = []
    zero = seen & (largest == 0.0)
    if zero.any():
        seen = np.asarray(seen & ~zero)
        lines.append(
            f"{int(zero.sum())} samples of {int(zero.any(axis=0).sum())} markers are exactly 0, 0, 0: not seen"
        )
    return places, seen, lines


def checked_times(where: str, times: Array, row: int = 1) -> Array:
    """Times (T,) that increase. ``row``: of the first one, for messages. Raises SceneInvalid."""
    if not np.isfinite(times).all():
        at = int(np.argmax(~np.isfinite(times)))
        raise refused(where, f"row {row + at} has no time ({times[at]:g})")
    steps = np.diff(times)
    if (steps <= 0.0).any():
        at = int(np.argmax(steps <= 0.0))
        again = int((steps <= 0.0).sum())
        raise refused(
            where,
            f"time does not increase: {times[at + 1]:.6g} s in row {row + at + 1} after {times[at]:.6g} s "
            f"({again} of {len(steps)} steps)",
        )
    return times


def sets_by_prefix(labels: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """The groups in labels of the form ``GROUP:NAME``."""
    found: dict[str, list[str]] = {}
    for label in labels:
        group, colon, rest = label.partition(":")
        if colon and group and rest:
            found.setdefault(group, []).append(label)
    return {group: tuple(members) for group, members in found.items()}
