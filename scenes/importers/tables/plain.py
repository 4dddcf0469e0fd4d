"""Import of plain columns: CSV, TSV or text with a time and x, y, z of every marker, wide or long.

Wide: one row a frame; the three columns of a marker are told by their names (``tip_x``, ``tip.X``, ``X_tip``, ``x1``,
``tip x [mm]``, ``tip_pos_x`` ...), or by two rows of heads, the marker's name over ``x, y, z``. Long: one row a
marker and frame, with a column that names the marker. Without heads the columns are x, y, z of one marker after
another, after a time if the first one is one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld_scenes.importers.tables.columns import Head, head_of, is_frame, is_marker_name, time_unit_of
from physworld_scenes.importers.tables.long_rows import read_long
from physworld_scenes.importers.tables.table import (
    UNIT_OF_WORD,
    MarkerTable,
    checked_labels,
    checked_places,
    checked_size,
    checked_times,
    named,
    refused,
    sets_by_prefix,
)
from physworld_scenes.importers.tables.text import (
    TextFile,
    cells_of,
    delimiter_of,
    is_number,
    rows_of,
    start_of,
)

FORM = "plain columns"
SUFFIXES, TEXT_SUFFIXES = (".csv", ".tsv"), (".txt", ".dat")
HEAD_ROWS, SNIFFED_ROWS = 8, 20
COMMENT = re.compile(r"^\s*(#|%|//)\s?")


def is_plain(data: bytes, filename: str) -> bool:
    """Whether a file is text that is called like columns, holds a row of three numbers, or begins with heads."""
    head = start_of(data)
    if not head.strip():
        return False
    if filename.lower().endswith(SUFFIXES):
        return True
    if filename.lower().endswith(TEXT_SUFFIXES):
        rows = (cells_of(line, delimiter_of(line)) for line in head.splitlines()[:SNIFFED_ROWS])
        return any(sum(map(is_number, cells)) >= 3 for cells in rows)
    first = COMMENT.sub("", head.lstrip().partition("\n")[0])
    letters = {head_of(cell).axis for cell in cells_of(first, delimiter_of(first))}
    return {"x", "y", "z"} <= letters


def read_table(data: bytes, where: str) -> MarkerTable:
    """The tracks in columns. Raises SceneInvalid."""
    file = TextFile(data, where)
    rows, delimiter = _head_rows(file)
    if not rows:
        return _without_heads(file, delimiter)
    heads = _joined(rows)
    letters = [head.axis for head in heads]
    named_by = [c for c, head in enumerate(heads) if is_marker_name(head.text)]
    plain_axes = [c for c, head in enumerate(heads) if head.axis and not head.name]
    if named_by and len(plain_axes) == 3 and sorted(letters[c] for c in plain_axes) == ["x", "y", "z"]:
        return read_long(file, delimiter, heads, named_by[0], plain_axes)
    return _wide(file, delimiter, heads)


def _head_rows(file: TextFile) -> tuple[list[list[str]], str]:
    """The rows of heads, and the delimiter; the file stands at the first row of numbers."""
    rows: list[list[str]] = []
    delimiter = ","
    while len(rows) < HEAD_ROWS:
        line = file.filled_line()
        if line is None:
            break
        bare = COMMENT.sub("", line)
        delimiter = delimiter_of(bare)
        cells = cells_of(bare, delimiter)
        numbers = sum(is_number(cell) for cell in cells)
        filled = sum(bool(cell) for cell in cells)
        if bare == line and numbers and 2 * numbers >= filled:
            file.back(line)
            return rows, delimiter
        rows.append(cells)
    raise refused(file.where, f"has no row of numbers in its first {file.number} lines")


def _joined(rows: list[list[str]]) -> list[Head]:
    """The heads of the columns: the last row, with the names over it where it holds axes alone."""
    last = rows[-1]
    heads = [head_of(cell) for cell in last]
    bare = [c for c, head in enumerate(heads) if head.axis and not head.name]
    if len(rows) == 1 or len(bare) <= 3:
        return heads
    above = [
        row
        for row in rows[:-1]
        if len(row) > min(bare) and any(row[c] for c in bare if c < len(row)) and len(set(row)) > 2
    ]
    if not above:
        return heads
    names, current = above[-1], ""
    for column in range(len(last)):
        current = (names[column] if column < len(names) else "") or current
        if column in bare:
            heads[column] = Head(last[column], current, heads[column].axis, heads[column].unit)
    return heads


@dataclass
class _Group:
    name: str
    columns: dict[str, int]


def _wide(file: TextFile, delimiter: str, heads: list[Head]) -> MarkerTable:
    groups, left = _groups(file.where, heads)
    time = next((c for c, head in enumerate(heads) if time_unit_of(head.text) is not None), None)
    units = {heads[c].unit for group in groups for c in group.columns.values()} - {""}
    if len(units) > 1:
        raise refused(file.where, f"the columns have the units {', '.join(sorted(units))}, not one")
    count = (
        next((c for c, head in enumerate(heads) if head.text and is_frame(head.text)), None)
        if time is None
        else None
    )
    used = {c for group in groups for c in group.columns.values()} | {
        c for c in (time, count) if c is not None
    }
    others = tuple(c for c in range(len(heads)) if c not in used)
    numbers, lines = rows_of(file, delimiter, len(heads), passed_over=others)
    checked_size(file.where, len(numbers), len(groups))
    labels = checked_labels(file.where, [group.name for group in groups])
    places = np.stack([numbers[:, [g.columns["x"], g.columns["y"], g.columns["z"]]] for g in groups], axis=1)
    places, seen, said = checked_places(file.where, labels, places)
    said += (
        [f"columns left out: {named([heads[c].text for c in left if c != time])}"]
        if [c for c in left if c != time]
        else []
    )
    times = None if time is None else seconds(file.where, numbers[:, time], heads[time].text, lines)
    frames = None if count is None else checked_times(file.where, numbers[:, count], lines[0] if lines else 1)
    return _table(labels, places, seen, times, frames, units, said)


def _groups(where: str, heads: list[Head]) -> tuple[list[_Group], list[int]]:
    """The markers with their columns, and the columns that belong to none and are no count of frames."""
    found: dict[str, _Group] = {}
    left: list[int] = []
    for column, head in enumerate(heads):
        if not head.axis:
            if head.text and not is_frame(head.text):
                left.append(column)
            continue
        group = found.setdefault(head.name, _Group(head.name or "marker", {}))
        if head.axis in group.columns:
            first = group.columns[head.axis] + 1
            raise refused(
                where, f"columns {first} and {column + 1} are both {head.axis} of marker {group.name!r}"
            )
        group.columns[head.axis] = column
    whole = [group for group in found.values() if len(group.columns) == 3]
    for group in found.values():
        if len(group.columns) != 3:
            left += group.columns.values()
    if not whole:
        heads_said = named([head.text for head in heads if head.text])
        raise refused(where, f"no marker has columns x, y and z; the columns are {heads_said}")
    return whole, sorted(left)


def _without_heads(file: TextFile, delimiter: str) -> MarkerTable:
    """Columns without names: x, y, z of one marker after another."""
    line = file.filled_line() or ""
    count = len([cell for cell in cells_of(line, delimiter) if cell])
    file.back(line)
    if count % 3 == 2 or count < 3:
        raise refused(
            file.where, f"has {count} columns without names: neither x, y, z of markers nor a time and these"
        )
    numbers, lines = rows_of(file, delimiter, count)
    timed = count % 3
    markers = count // 3
    checked_size(file.where, len(numbers), markers)
    labels = tuple(f"m{number + 1}" for number in range(markers))
    places = numbers[:, timed:].reshape(len(numbers), markers, 3)
    places, seen, said = checked_places(file.where, labels, places)
    said.append(
        f"no heads of columns: {'a time, then ' if timed else ''}x, y, z of {markers} markers are assumed"
    )
    times = checked_times(file.where, numbers[:, 0], lines[0]) if timed else None
    return _table(labels, places, seen, times, None, set(), said)


def seconds(where: str, values: Array, head: str, lines: list[int]) -> Array:
    """A column of times in seconds, by its head.

    Args:
        where: the file, for messages.
        values: of the column (T,).
        head: its heading; the unit is read there, else it is seconds.
        lines: of the values in the file.

    Raises:
        SceneInvalid: times that are not finite or do not increase.
    """
    return checked_times(where, values * (time_unit_of(head) or 1.0), lines[0] if lines else 1)


def _table(
    labels: tuple[str, ...],
    places: Array,
    seen: Array,
    times: Array | None,
    frames: Array | None,
    units: set[str],
    said: list[str],
) -> MarkerTable:
    return MarkerTable(
        form=FORM,
        labels=labels,
        places=places,
        seen=seen,
        times=times,
        frames=frames,
        unit=UNIT_OF_WORD[units.pop()] if units else None,
        unit_from="the heads of the columns say so",
        sets=sets_by_prefix(labels),
        lines=tuple(said),
    )
