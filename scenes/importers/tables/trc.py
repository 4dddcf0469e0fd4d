"""Import of TRC, the tracks that OpenSim, Cortex and Motive exchange.

Five lines of heads: ``PathFileType``, names of the facts, their values (``DataRate``, ``NumFrames``, ``NumMarkers``,
``Units`` ...), ``Frame#, Time`` with the markers' names over the first of three columns, and X1, Y1, Z1 ...; an empty
line may follow. An empty cell is a place that is not seen. OpenSim's world has y up.
"""

from __future__ import annotations

import re

import numpy as np

from physworld_scenes.importers.tables.table import (
    MarkerTable,
    checked_labels,
    checked_places,
    checked_size,
    checked_times,
    refused,
    sets_by_prefix,
    unit_of,
)
from physworld_scenes.importers.tables.text import (
    TextFile,
    cells_of,
    delimiter_of,
    is_number,
    number_in,
    rows_of,
    start_of,
)

FORM = "TRC"
MARK = "PathFileType"
AXES = re.compile(r"^[XYZ]\d*$", re.IGNORECASE)


def is_trc(data: bytes, filename: str) -> bool:
    """Whether a file begins like a TRC."""
    return start_of(data).lstrip().startswith(MARK)


def read_table(data: bytes, where: str) -> MarkerTable:
    """The tracks in a TRC file. Raises SceneInvalid."""
    file = TextFile(data, where)
    file.filled_line()
    keys_line, values_line, names_line = (file.filled_line() or "" for _ in range(3))
    delimiter = delimiter_of(keys_line)
    facts = dict(
        zip(
            (key.lower() for key in cells_of(keys_line, delimiter)),
            cells_of(values_line, delimiter),
            strict=False,
        )
    )
    count, rate = number_in(facts.get("nummarkers", "")), number_in(facts.get("datarate", ""))
    if count is None or not 0.0 < count < 1e9:
        raise refused(where, f"NumMarkers is {facts.get('nummarkers', 'missing')}")
    heads = cells_of(names_line, delimiter)
    if len(heads) < 2 or not heads[0].lower().startswith("frame") or not heads[1].lower().startswith("time"):
        raise refused(where, f"line {file.number} does not begin with Frame# and Time")
    names = [cell for cell in heads[2:] if cell]
    if len(names) != int(count):
        raise refused(where, f"has {len(names)} names of markers, NumMarkers is {count:.0f}")
    labels = checked_labels(where, names)
    axes_line = file.filled_line() or ""
    axes = [cell for cell in cells_of(axes_line, delimiter) if cell]
    if axes and all(is_number(cell) for cell in axes):
        file.back(axes_line)
    elif len(axes) != 3 * len(labels) or not all(AXES.match(cell) for cell in axes):
        raise refused(
            where, f"line {file.number} names {len(axes)} columns X, Y, Z for {len(labels)} markers"
        )
    numbers, lines = rows_of(file, delimiter, 2 + 3 * len(labels))
    if not len(numbers):
        raise refused(where, f"has no row of numbers after line {file.number}")
    checked_size(where, len(numbers), len(labels))
    places = numbers[:, 2:].reshape(len(numbers), len(labels), 3)
    places, seen, said = checked_places(where, labels, places)
    frames = number_in(facts.get("numframes", ""))
    if frames is not None and frames == frames and frames != len(numbers):
        said.append(f"the header says {frames:.0f} frames, {len(numbers)} are there")
    return MarkerTable(
        form=FORM,
        labels=labels,
        places=places,
        seen=seen,
        times=checked_times(where, np.asarray(numbers[:, 1]), lines[0]),
        rate_hz=rate if rate is not None and rate > 0.0 else None,
        unit=unit_of(facts["units"], where) if facts.get("units") else None,
        up="y",
        up_from="OpenSim's convention",
        sets=sets_by_prefix(labels),
        lines=tuple(said),
    )
