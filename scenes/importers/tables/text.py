"""Tables as text: lines with their numbers, cells, and blocks of numbers, read without ever holding the file twice.

Limits are of the file, a line and a row, so that a hostile file is refused by its numbers before memory is taken.
"""

from __future__ import annotations

import contextlib
import csv
import io
import re

import numpy as np

from physworld.arrays import Array
from physworld_scenes.importers.tables.table import MOST_MARKERS, MOST_VALUES, refused, shortened

MOST_BYTES = 256 << 20
MOST_LINE_BYTES = 1 << 20
MOST_COLUMNS = 3 * MOST_MARKERS + 16
DELIMITERS = ("\t", ";", ",")
SNIFFED_BYTES = 64 << 10
NOT_A_NUMBER = frozenset({"", "nan", "null", "none", "n/a", "na", "-", "--", "inf", "-inf", "+inf"})
WORDS = re.compile(r"\s+")


class TextFile:
    """The lines of a text file, one after another.

    Attributes:
        where: the file's name, in errors.
        number: of the line that was read last, from 1.
    """

    def __init__(self, data: bytes, where: str) -> None:
        if len(data) > MOST_BYTES:
            raise refused(where, f"has {len(data)} bytes, at most {MOST_BYTES} of text are read")
        if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
            raise refused(where, "is UTF-16 text; save it as UTF-8")
        head = data[:SNIFFED_BYTES]
        if b"\r" in head and b"\n" not in head:  # lines end as on a Mac of old
            data = data.replace(b"\r", b"\n")
        self.where, self.number = where, 0
        self._stream = io.BytesIO(data)
        self._again: str | None = None
        if data[:3] == b"\xef\xbb\xbf":
            self._stream.seek(3)

    def line(self) -> str | None:
        """The next line without its end; None after the last. Raises SceneInvalid: too long, or no text."""
        if self._again is not None:
            text, self._again = self._again, None
            self.number += 1
            return text
        raw = self._stream.readline(MOST_LINE_BYTES + 1)
        if not raw:
            return None
        self.number += 1
        if len(raw) > MOST_LINE_BYTES:
            rest = self._stream.readline(MOST_BYTES)
            commas = (
                raw.count(b",") + raw.count(b"\t") + raw.count(b";") + rest.count(b",") + rest.count(b"\t")
            )
            raise self.fault(
                f"has {len(raw) + len(rest)} bytes in about {commas + 1} columns, at most {MOST_LINE_BYTES}"
            )
        if b"\0" in raw:
            raise self.fault(f"is no text: a zero byte at its character {raw.index(0) + 1}")
        return raw.decode("utf-8", errors="replace").rstrip("\r\n")

    def back(self, line: str) -> None:
        """Give the last line back: it is read again."""
        self._again, self.number = line, self.number - 1

    def filled_line(self) -> str | None:
        """The next line that holds anything."""
        while (line := self.line()) is not None:
            if line.strip(' ,;\t"'):
                return line
        return None

    def fault(self, message: str) -> Exception:
        """An error about the line that was read last."""
        return refused(self.where, f"line {self.number} {message}")


def start_of(data: bytes) -> str:
    """The beginning of a file as text, '' if it is none."""
    head = data[:SNIFFED_BYTES]
    if b"\0" in head:
        return ""
    return head.decode("utf-8-sig", errors="replace")


def delimiter_of(line: str) -> str:
    """What separates the cells of a line: a tab, a semicolon, a comma, else blanks (' ')."""
    counts = {mark: line.count(mark) for mark in DELIMITERS}
    best = max(DELIMITERS, key=lambda mark: counts[mark])
    if counts[";"] and counts[";"] * 4 >= counts[best]:
        return ";"  # commas are decimal ones
    return best if counts[best] else " "


def cells_of(line: str, delimiter: str) -> list[str]:
    """The cells of a line, without blanks and quotes around them."""
    if delimiter == " ":
        return WORDS.split(line.strip()) if line.strip() else []
    if '"' in line:
        with contextlib.suppress(csv.Error):
            return [
                cell.strip().strip('"').strip() for cell in next(csv.reader([line], delimiter=delimiter), [])
            ]
    return [cell.strip() for cell in line.split(delimiter)]


def number_in(text: str) -> float | None:
    """The number that a cell holds, with a decimal point or comma; None if it holds another thing."""
    word = text.strip().strip('"').lower()
    if word in NOT_A_NUMBER:
        return float("nan")
    try:
        return float(word)
    except ValueError:
        pass
    try:
        return float(word.replace(",", ".")) if word.count(",") == 1 and "." not in word else None
    except ValueError:
        return None


def is_number(text: str) -> bool:
    """Whether a cell holds a finite number."""
    value = number_in(text)
    return value is not None and value == value


def rows_of(
    file: TextFile, delimiter: str, columns: int, ends: bool = False, passed_over: tuple[int, ...] = ()
) -> tuple[Array, list[int]]:
    """The rows of numbers from here on, (T, columns), nan where a cell is empty, and their line numbers.

    Args:
        file: at the first row.
        delimiter: between cells.
        columns: that every row has; more cells must be empty.
        ends: whether an empty line ends the block; else empty lines are passed over.
        passed_over: columns that hold no numbers: nan.

    Raises:
        SceneInvalid: a row is shorter or longer, or a cell holds no number.
    """
    if columns > MOST_COLUMNS:
        raise refused(file.where, f"has {columns} columns, at most {MOST_COLUMNS} are read")
    blocks: list[Array] = []
    lines: list[int] = []
    most = MOST_VALUES // max(columns, 1)
    block = np.empty((0, columns))
    filled = 0
    while (line := file.line()) is not None:
        if not line.strip(' ,;\t"'):
            if ends:
                break
            continue
        if len(lines) >= most:
            raise refused(
                file.where,
                f"has more than {most} rows of {columns} columns, at most {MOST_VALUES} values are read",
            )
        if filled == len(block):
            blocks.append(block[:filled])
            block, filled = np.empty((min(max(1024, len(lines)), 1 << 16), columns)), 0
        block[filled] = _numbers(file, line, delimiter, columns, passed_over)
        filled += 1
        lines.append(file.number)
    blocks.append(block[:filled])
    return np.concatenate(blocks), lines


def _numbers(
    file: TextFile, line: str, delimiter: str, columns: int, passed_over: tuple[int, ...]
) -> list[float]:
    """The numbers of one row; the usual row takes the first, short way."""
    cells = line.split(delimiter) if delimiter != " " and '"' not in line else cells_of(line, delimiter)
    while len(cells) > columns and not cells[-1].strip():
        cells.pop()
    if len(cells) != columns:
        raise file.fault(f"has {len(cells)} columns, the header has {columns}; is the file cut short?")
    for column in passed_over:
        cells[column] = ""
    try:
        return [float(cell) if cell else np.nan for cell in cells]
    except ValueError:
        pass
    values = []
    for column, cell in enumerate(cells):
        value = number_in(cell)
        if value is None:
            raise file.fault(f"holds {shortened(cell)!r} in column {column + 1}, which is no number")
        values.append(value)
    return values
