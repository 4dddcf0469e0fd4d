"""Import of Qualisys Track Manager's TSV with 3D data.

Lines of a name and its values (``NO_OF_FRAMES``, ``FREQUENCY``, ``MARKER_NAMES`` ...), then rows of X, Y, Z of every
marker in millimetres. Options of QTM add a row of column heads, columns of frame and time in front, and the types of
the trajectories; without them a missing place is empty or zero. QTM's world has z up.
"""

from __future__ import annotations

from physworld_scenes.importers.tables.table import (
    MarkerTable,
    checked_labels,
    checked_places,
    checked_size,
    checked_times,
    refused,
    sets_by_prefix,
    shortened,
)
from physworld_scenes.importers.tables.text import TextFile, cells_of, is_number, number_in, rows_of, start_of

FORM = "Qualisys QTM TSV"
MARKS = ("NO_OF_FRAMES\t", "FILE_VERSION\t")
HEADER_LINES = 1000


def is_qualisys(data: bytes, filename: str) -> bool:
    """Whether a file begins like QTM's TSV."""
    return start_of(data).lstrip().startswith(MARKS)


def read_table(data: bytes, where: str) -> MarkerTable:
    """The tracks in QTM's TSV. Raises SceneInvalid."""
    file = TextFile(data, where)
    values, heads = _header(file)
    names = [name for name in values.get("MARKER_NAMES", []) if name]
    included = " ".join(values.get("DATA_INCLUDED", ["3D"])).strip()
    if included.upper() != "3D":
        raise refused(where, f"holds {shortened(included)!r} data; export 3D data from QTM")
    claimed = number_in(values.get("NO_OF_MARKERS", [""])[0])
    if not names or (claimed == claimed and claimed != len(names)):
        raise refused(
            where,
            f"MARKER_NAMES has {len(names)} names, NO_OF_MARKERS is {claimed if claimed == claimed else 'missing'}",
        )
    labels = checked_labels(where, names)
    first = file.filled_line()
    if first is None:
        raise refused(where, f"has no row of numbers after line {file.number}")
    cells = cells_of(first, "\t")
    while len(cells) > 3 * len(labels) and not cells[-1]:
        cells.pop()
    extra = len(heads) - 3 * len(labels) if heads else len(cells) - 3 * len(labels)
    if extra not in (0, 1, 2):
        raise refused(where, f"line {file.number} has {len(cells)} columns for {len(labels)} markers of 3")
    file.back(first)
    numbers, lines = rows_of(file, "\t", 3 * len(labels) + extra)
    checked_size(where, len(numbers), len(labels))
    places = numbers[:, extra:].reshape(len(numbers), len(labels), 3)
    places, seen, said = checked_places(where, labels, places)
    rate = number_in(values.get("FREQUENCY", [""])[0])
    frames = number_in(values.get("NO_OF_FRAMES", [""])[0])
    if frames == frames and frames is not None and frames != len(numbers):
        said.append(f"the header says {frames:.0f} frames, {len(numbers)} are there")
    times = None
    if extra and (extra == 2 or heads[0].lower() == "time"):
        times = checked_times(where, numbers[:, extra - 1], lines[0])
    return MarkerTable(
        form=f"{FORM} {values['FILE_VERSION'][0]}" if values.get("FILE_VERSION") else FORM,
        labels=labels,
        places=places,
        seen=seen,
        times=times,
        rate_hz=rate if rate is not None and rate > 0.0 else None,
        unit="mm",
        unit_from="QTM exports millimetres",
        up="z",
        up_from="QTM's convention",
        sets=sets_by_prefix(labels),
        lines=tuple(said),
    )


def _header(file: TextFile) -> tuple[dict[str, list[str]], list[str]]:
    """The lines before the numbers: name to values; and the heads of the columns, if there are any."""
    values: dict[str, list[str]] = {}
    heads: list[str] = []
    while (line := file.filled_line()) is not None:
        cells = cells_of(line, "\t")
        if is_number(next((cell for cell in cells if cell), "")):
            file.back(line)
            break
        key = cells[0]
        if (key.isupper() and "_" in key) or key in ("FREQUENCY", "DESCRIPTION", "EVENT"):
            values.setdefault(key, cells[1:])
        else:
            heads = [cell for cell in cells if cell]
        if file.number > HEADER_LINES:
            raise refused(file.where, f"has no row of numbers in its first {HEADER_LINES} lines")
    return values, heads
