"""Plain columns in the long layout: one row a marker and frame, with a column that names the marker."""

from __future__ import annotations

from array import array

import numpy as np

from physworld.arrays import Array
from physworld_scenes.importers.tables.columns import Head, is_frame, time_unit_of
from physworld_scenes.importers.tables.table import (
    MOST_MARKERS,
    MOST_VALUES,
    MarkerTable,
    checked_labels,
    checked_places,
    checked_size,
    named,
    refused,
    sets_by_prefix,
    shortened,
)
from physworld_scenes.importers.tables.text import TextFile, cells_of, number_in

FORM = "plain columns, long"


def read_long(
    file: TextFile, delimiter: str, heads: list[Head], name_at: int, axes: list[int]
) -> MarkerTable:
    """The tracks in rows of time (or frame), marker, x, y, z; the file stands at the first of them.

    Args:
        file: stands at the first row of values.
        delimiter: between cells.
        heads: of the columns.
        name_at: column of the marker's name.
        axes: columns of x, y and z, in any order.

    Raises:
        SceneInvalid: no column of time or frames, two rows of one marker and frame, or a cell that is no number.
    """
    where = file.where
    time = next((c for c, head in enumerate(heads) if time_unit_of(head.text) is not None), None)
    frame = next((c for c, head in enumerate(heads) if head.text and is_frame(head.text)), None)
    clock = time if time is not None else frame
    if clock is None:
        raise refused(
            where, f"has neither a time nor a frame; its columns are {named([head.text for head in heads])}"
        )
    x, y, z = sorted(axes, key=lambda column: heads[column].axis)
    clocks, markers, values, order, lines = _rows(file, delimiter, len(heads), (clock, name_at, x, y, z))
    moments, row = np.unique(clocks, return_inverse=True)
    checked_size(where, len(moments), len(order))
    cell = row * len(order) + markers
    _, first, count = np.unique(cell, return_index=True, return_counts=True)
    if (count > 1).any():
        at = int(first[np.argmax(count > 1)])
        again = int(np.flatnonzero(cell == cell[at])[1])
        raise refused(
            where,
            f"lines {lines[at]} and {lines[again]} are both of {shortened(order[markers[at]])} at {clocks[at]:g}",
        )
    places = np.full((len(moments) * len(order), 3), np.nan)
    places[cell] = values
    labels = checked_labels(where, order)
    places, seen, said = checked_places(where, labels, places.reshape(len(moments), len(order), 3))
    units = {heads[column].unit for column in axes} - {""}
    left = [
        head.text for c, head in enumerate(heads) if c not in (clock, name_at, frame, *axes) and head.text
    ]
    if left:
        said.append(f"columns left out: {named(left)}")
    return MarkerTable(
        form=FORM,
        labels=labels,
        places=places,
        seen=seen,
        times=None if time is None else moments * (time_unit_of(heads[time].text) or 1.0),
        frames=moments if time is None else None,
        unit=units.pop() if len(units) == 1 else None,
        unit_from="the heads of the columns say so",
        sets=sets_by_prefix(labels),
        lines=tuple(said),
    )


def _rows(
    file: TextFile, delimiter: str, columns: int, wanted: tuple[int, ...]
) -> tuple[Array, Array, Array, list[str], Array]:
    """Clock (R,), index of the marker (R,), place (R, 3), the markers' names in their order, line numbers."""
    clock_at, name_at, *axes = wanted
    index: dict[str, int] = {}
    clocks, values = array("d"), array("d")
    markers, lines = array("q"), array("q")
    while (line := file.filled_line()) is not None:
        cells = cells_of(line, delimiter)
        if len(cells) < max(wanted) + 1 or len(cells) > columns + 1:
            raise file.fault(f"has {len(cells)} columns, the header has {columns}; is the file cut short?")
        numbers = [number_in(cells[column]) for column in (clock_at, *axes)]
        if None in numbers or numbers[0] != numbers[0]:
            wrong = numbers.index(None) if None in numbers else 0
            raise file.fault(f"holds {shortened(cells[(clock_at, *axes)[wrong]])!r}, which is no number")
        clocks.append(float(numbers[0] or 0.0))
        markers.append(index.setdefault(cells[name_at], len(index)))
        values.extend(float(number or 0.0) for number in numbers[1:])
        lines.append(file.number)
        if len(index) > MOST_MARKERS:
            raise file.fault(f"names marker {len(index)}; at most {MOST_MARKERS} are read")
        if 3 * len(lines) > MOST_VALUES // 4:
            raise file.fault(f"is row {len(lines)}; at most {MOST_VALUES // 12} rows of this layout are read")
    return (
        np.array(clocks), np.array(markers), np.array(values).reshape(-1, 3), list(index), np.array(lines),
    )  # fmt: skip
