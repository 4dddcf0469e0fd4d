"""Import of OptiTrack Motive's CSV.

The first line is pairs of names and values, from ``Format Version``. Then come rows that say what each column is:
type (Marker, Rigid Body, Rigid Body Marker, Bone ...), name, ID, in versions from 1.25 the parent, the kind of value
(Position, Rotation, Mean Marker Error ...), and at last ``Frame, Time (Seconds)`` with X, Y, Z, W. Versions before
1.24 have no words in front of these rows, later ones do, and may have a column of time codes: rows and columns are
found by what they hold, not by their number. Motive's world has y up unless it was exported otherwise, which the file
does not say.

Of a rigid body the solved markers (``Rigid Body Marker``) take the place of the measured ones of the same name.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from physworld.arrays import Array
from physworld_scenes.importers.tables.table import (
    UNLABELLED,
    MarkerTable,
    RigidBody,
    checked_labels,
    checked_places,
    checked_size,
    checked_times,
    named,
    refused,
    unit_of,
)
from physworld_scenes.importers.tables.text import TextFile, cells_of, number_in, rows_of, start_of

FORM = "OptiTrack Motive CSV"
MARK = "Format Version"
MARKER, SOLVED, BODY = "marker", "rigid body marker", "rigid body"
DESCRIBING_ROWS = 12


@dataclass
class _Columns:
    """Where the columns of one thing are: first column of X, Y, Z, and those of a quaternion X, Y, Z, W."""

    kind: str
    name: str
    place: int | None = None
    turn: int | None = None
    euler: bool = False


@dataclass
class _Header:
    values: dict[str, str]
    things: list[_Columns] = field(default_factory=list)
    ignored: dict[str, int] = field(default_factory=dict)
    columns: int = 0
    codes: tuple[int, ...] = ()
    """Columns of time codes."""


def is_motive(data: bytes, filename: str) -> bool:
    """Whether a file begins like Motive's CSV."""
    return start_of(data).lstrip().lstrip('"').startswith(MARK)


def read_table(data: bytes, where: str) -> MarkerTable:
    """The tracks in Motive's CSV. Raises SceneInvalid."""
    file = TextFile(data, where)
    header = _header(file)
    numbers, lines = rows_of(file, ",", header.columns, passed_over=header.codes)
    if not len(numbers):
        raise refused(where, f"has no row of numbers after line {file.number}")
    times = checked_times(where, numbers[:, 1], lines[0])
    markers, lines_said = _markers(header)
    bodies = [thing for thing in header.things if thing.kind == BODY and thing.place is not None]
    checked_size(where, len(numbers), len(markers) + len(bodies))
    labels = checked_labels(where, [thing.name for thing in markers])
    places = np.stack([_triple(numbers, thing.place) for thing in markers], axis=1) if markers else np.zeros(
        (len(numbers), 0, 3)
    )  # fmt: skip
    places, seen, zeros = checked_places(where, labels, places)
    said = header.values
    return MarkerTable(
        form=f"{FORM} {said.get(MARK.lower(), '')}".strip(),
        labels=labels,
        places=places,
        seen=seen,
        times=times,
        rate_hz=_rate(said),
        unit=unit_of(said["length units"], where) if said.get("length units") else None,
        up="y",
        up_from="Motive's convention",
        sets=_sets(labels, [thing.name for thing in bodies]),
        bodies=tuple(_body(where, numbers, thing) for thing in bodies),
        lines=tuple(lines_said + zeros + _missing(said, len(numbers)) + _not_read(header)),
    )


def _header(file: TextFile) -> _Header:
    """What the lines before the numbers say."""
    first = file.filled_line()
    cells = cells_of(first or "", ",")
    if not cells or not cells[0].startswith(MARK):
        raise file.fault(f"does not begin with {MARK}")
    header = _Header({name.lower(): value for name, value in zip(cells[::2], cells[1::2], strict=False)})
    rows: list[list[str]] = []
    while True:
        line = file.filled_line()
        if line is None or len(rows) > DESCRIBING_ROWS:
            raise refused(file.where, f"has no row that begins with Frame in its first {file.number} lines")
        row = cells_of(line, ",")
        if row[0].lower() == "frame":
            break
        if number_in(row[0]) is not None and row[0]:
            raise refused(
                file.where, f"line {file.number} holds numbers before any row that begins with Frame"
            )
        rows.append(row)
    if len(rows) < 3:
        raise refused(
            file.where, f"has {len(rows)} rows that say what the columns are; type, name and kind are needed"
        )
    if len(row) < 2 or not row[1].lower().startswith("time"):
        raise refused(file.where, f"line {file.number} has no column of time after Frame")
    header.columns = len(row)
    while header.columns > 2 and not any(
        header.columns <= len(r) and r[header.columns - 1] for r in (*rows, row)
    ):
        header.columns -= 1
    wide = [[*r, *([""] * (header.columns - len(r)))] for r in (*rows, row)]
    header.codes = tuple(c for c in range(2, header.columns) if wide[-1][c].lower().startswith("timecode"))
    _things(header, wide[0], wide[1], wide[2] if len(rows) > 3 else [""] * header.columns, wide[-2], wide[-1])
    return header


def _things(
    header: _Header, types: list[str], names: list[str], keys: list[str], kinds: list[str], axes: list[str]
) -> None:
    """Sort the columns by what they belong to."""
    found: dict[tuple[str, str, str, int], _Columns] = {}
    column = 2
    while column < header.columns:
        kind, value = types[column].lower(), kinds[column].lower()
        letters = [axis.lower() for axis in axes[column : column + 4]]
        same = sum(
            1
            for c in range(column, min(column + 4, header.columns))
            if names[c] == names[column] and kinds[c].lower() == value
        )
        step = 1
        if kind in (MARKER, SOLVED, BODY) and letters[:3] == ["x", "y", "z"] and same >= 3:
            key = (kind, names[column], keys[column], 0)
            while value == "position" and key in found and found[key].place is not None:
                key = (*key[:3], key[3] + 1)
            thing = found.setdefault(key, _Columns(kind, names[column]))
            step = 3
            if value == "position":
                thing.place = column
            elif value == "rotation" and letters[3:] == ["w"] and same == 4:
                thing.turn, step = column, 4
            elif value == "rotation":
                thing.euler = True
        elif kind and kind not in (MARKER, SOLVED, BODY):
            header.ignored[types[column]] = header.ignored.get(types[column], 0) + 1
        column += step
    header.things = list(found.values())


def _markers(header: _Header) -> tuple[list[_Columns], list[str]]:
    """The markers to read, the solved ones of rigid bodies in the place of measured ones of that name."""
    solved = {thing.name for thing in header.things if thing.kind == SOLVED and thing.place is not None}
    kept = [
        thing
        for thing in header.things
        if thing.place is not None
        and (thing.kind == SOLVED or (thing.kind == MARKER and thing.name not in solved))
    ]
    replaced = [thing.name for thing in header.things if thing.kind == MARKER and thing.name in solved]
    lines = []
    if replaced:
        lines.append(
            f"{len(replaced)} measured markers of rigid bodies give way to the solved ones: {named(replaced)}"
        )
    return kept, lines


def _sets(labels: tuple[str, ...], bodies: list[str]) -> dict[str, tuple[str, ...]]:
    """The groups: markers called after a rigid body, or with a group and a colon before their name."""
    found: dict[str, list[str]] = {name: [] for name in bodies}
    for label in labels:
        plain = label.replace('"', "")
        owner = max(
            (b for b in bodies if plain.startswith(b) and plain[len(b) : len(b) + 1] in (":", "-", "_", " ")),
            key=len,
            default=None,
        )
        group, colon, rest = plain.partition(":")
        if owner is not None:
            found[owner].append(label)
        elif colon and group and rest and not UNLABELLED.match(plain):
            found.setdefault(group, []).append(label)
    return {name: tuple(members) for name, members in found.items() if members}


def _body(where: str, numbers: Array, thing: _Columns) -> RigidBody:
    """The poses of a rigid body; a frame without one is not seen."""
    places = _triple(numbers, thing.place)
    turns = None
    seen: Array = np.asarray(np.isfinite(places).all(axis=1))
    if thing.turn is not None:
        xyzw = numbers[:, thing.turn : thing.turn + 4]
        length = np.linalg.norm(np.where(np.isfinite(xyzw), xyzw, 0.0), axis=1)
        seen &= np.isfinite(xyzw).all(axis=1)
        wrong = seen & (np.abs(length - 1.0) > 1e-2)
        if wrong.any():
            frame = int(np.argmax(wrong))
            raise refused(
                where,
                f"the quaternion of {thing.name} has length {length[frame]:.4g} in frame {frame}, not 1",
            )
        turns = np.where(
            seen[:, None], xyzw[:, [3, 0, 1, 2]] / np.maximum(length, 1e-12)[:, None], [1.0, 0.0, 0.0, 0.0]
        )
    return RigidBody(thing.name, np.where(seen[:, None], places, 0.0), turns, seen)


def _triple(numbers: Array, column: int | None) -> Array:
    assert column is not None
    return numbers[:, column : column + 3]


def _rate(said: dict[str, str]) -> float | None:
    for key in ("export frame rate", "capture frame rate"):
        rate = number_in(said.get(key, ""))
        if rate is not None and rate > 0.0:
            return rate
    return None


def _missing(said: dict[str, str], frames: int) -> list[str]:
    claimed = number_in(said.get("total exported frames", ""))
    if claimed is None or claimed != claimed or claimed == frames:
        return []
    return [f"the header says {claimed:.0f} frames, {frames} are there"]


def _not_read(header: _Header) -> list[str]:
    lines = [f"{count} columns of type {kind} are left out" for kind, count in header.ignored.items()]
    angles = [thing.name for thing in header.things if thing.kind == BODY and thing.euler]
    if angles:
        lines.append(f"angles of {named(angles)} are left out; only quaternions are read")
    if header.values.get("coordinate space", "global").lower() != "global":
        lines.append(f"the coordinate space is {header.values['coordinate space']}, not Global")
    return lines
