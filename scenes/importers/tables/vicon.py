"""Import of Vicon Nexus' CSV: its section ``Trajectories``.

A section is a line with its name, a line with its rate, and three rows of heads: names (``SUBJECT:MARKER`` over the
first of three columns), ``Frame, Sub Frame, X, Y, Z ...`` and units; rows of numbers follow up to an empty line.
Other sections (devices, model outputs), velocities (X') and accelerations (X'') are left out. Vicon's world has z up.
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
    shortened,
    unit_of,
)
from physworld_scenes.importers.tables.text import TextFile, cells_of, delimiter_of, number_in, rows_of

FORM = "Vicon Nexus CSV"
SECTION = re.compile(rb'^[ \t]*"?Trajectories"?[ \t,;]*\r?$', re.MULTILINE)
OTHERS = ("Devices", "Model Outputs", "Joints", "Segments", "Events", "Center of Mass")


def is_vicon(data: bytes, filename: str) -> bool:
    """Whether a text file has Nexus' section of trajectories."""
    return b"\0" not in data[:4096] and SECTION.search(data) is not None


def read_table(data: bytes, where: str) -> MarkerTable:
    """The tracks in Nexus' CSV. Raises SceneInvalid."""
    file = TextFile(data, where)
    left_out = []
    while (line := file.line()) is not None:
        word = line.strip(' ,;\t"')
        if word == "Trajectories":
            break
        if word in OTHERS:
            left_out.append(word)
    rate_line, names_line, axes_line, units_line = (file.filled_line() or "" for _ in range(4))
    rate = number_in(rate_line.strip(" ,;\t"))
    if rate is None or not rate > 0.0:
        raise refused(where, f"the rate of the section Trajectories is {shortened(rate_line)!r}")
    delimiter = delimiter_of(axes_line)
    names, axes, units = (cells_of(text, delimiter) for text in (names_line, axes_line, units_line))
    if [cell.lower() for cell in axes[:2]] != ["frame", "sub frame"]:
        raise refused(
            where,
            f"line {file.number - 1} begins with {shortened(axes_line)!r}, not with Frame and Sub Frame",
        )
    while axes and not axes[-1]:
        axes.pop()
    columns = [c for c in range(2, len(axes) - 2) if [a.upper() for a in axes[c : c + 3]] == ["X", "Y", "Z"]]
    if not columns:
        raise refused(where, f"line {file.number - 1} has no columns X, Y, Z")
    words = {units[c].lower() for first in columns for c in range(first, first + 3) if c < len(units)}
    if len(words) != 1:
        raise refused(
            where, f"the units of the trajectories are {', '.join(sorted(words)) or 'not given'}, not one"
        )
    labels = checked_labels(where, [names[c] if c < len(names) else "" for c in columns])
    numbers, lines = rows_of(file, delimiter, len(axes), ends=True)
    if not len(numbers):
        raise refused(where, f"has no row of numbers after line {file.number}")
    checked_size(where, len(numbers), len(columns))
    frames = checked_times(where, numbers[:, 0], lines[0])
    places = np.stack([numbers[:, c : c + 3] for c in columns], axis=1)
    places, seen, said = checked_places(where, labels, places)
    while (line := file.line()) is not None:
        word = line.strip(' ,;\t"')
        if word in OTHERS:
            left_out.append(word)
    if left_out:
        said.append(f"sections left out: {', '.join(left_out)}")
    return MarkerTable(
        form=FORM,
        labels=labels,
        places=places,
        seen=seen,
        times=(frames - frames[0]) / rate,
        rate_hz=rate,
        unit=unit_of(words.pop(), where),
        up="z",
        up_from="Vicon's convention",
        sets=sets_by_prefix(labels),
        lines=tuple(said),
    )
