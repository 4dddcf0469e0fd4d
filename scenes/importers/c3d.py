"""Import of C3D motion capture, parsed by ezc3d in a child process.

Units come from POINT:UNITS, the rate from POINT:RATE, the axis that points up from POINT:X_SCREEN and Y_SCREEN where
they tell it, else it is taken to be z. A sample whose residual is negative or which is not a number is a gap.
"""

from __future__ import annotations

import math
import struct

import numpy as np

from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers.library import parsed
from physworld_scenes.importers.tables.table import (
    MarkerTable,
    checked_labels,
    checked_places,
    checked_size,
    sets_by_prefix,
    unit_of,
)
from physworld_schemas.base import FieldError

C3D_MAGIC = 0x50
BLOCK_BYTES = 512
MOST_DESCRIBED = 127
"""Characters of a description: the library takes the byte that counts them for one with a sign."""


def is_c3d(data: bytes, filename: str = "") -> bool:
    """Whether the bytes begin like a C3D file."""
    return len(data) >= BLOCK_BYTES and data[1] == C3D_MAGIC and 2 <= data[0] <= 64


def read_table(data: bytes, where: str) -> MarkerTable:
    """The markers of a C3D file.

    Raises:
        SceneInvalid: it is no C3D file, it is cut short, or it cannot be parsed.
    """
    _check_header(data)
    arrays, facts = parsed("c3d", data, "c3d")
    positions, residuals = arrays["positions"], arrays["residuals"]
    checked_size("c3d", len(positions), positions.shape[1])
    if not (np.isfinite(facts["rate_hz"]) and facts["rate_hz"] > 0.0):
        raise _invalid([f"POINT:RATE is {facts['rate_hz']:g} Hz"])
    labels = checked_labels("c3d", [label or f"marker{i}" for i, label in enumerate(facts["labels"])])
    gaps = ~((residuals >= 0.0) & np.isfinite(residuals))
    places, seen, said = checked_places("c3d", labels, np.where(gaps[..., None], np.nan, positions))
    up = _up(*facts["screen"])
    return MarkerTable(
        form="C3D",
        labels=labels,
        places=places,
        seen=seen,
        rate_hz=facts["rate_hz"],
        unit=unit_of(facts["unit"], "c3d"),
        unit_from="POINT:UNITS says so",
        up=up or "z",
        up_from="POINT:X_SCREEN and Y_SCREEN say so" if up else "the usual axis of C3D",
        sets=sets_by_prefix(labels),
        lines=tuple(said),
    )


def _up(x_screen: str, y_screen: str) -> str | None:
    """The axis that points up on the screen, of two words like +X and +Z; None where they say nothing."""
    word = y_screen.strip().lower().lstrip("+")
    return word if word.lstrip("-") in ("x", "y", "z") and x_screen.strip() else None


def _check_header(data: bytes) -> None:
    """The magic, and that the file is as long as its header's frames and markers need."""
    if not is_c3d(data):
        raise _invalid([f"is no C3D file (it begins with {data[:4].hex(' ') or 'nothing'})"])
    processor_at = (data[0] - 1) * BLOCK_BYTES + 3
    if processor_at >= len(data):
        raise _invalid([f"is cut short: {len(data)} bytes, its parameters begin at {processor_at - 3}"])
    endian = ">" if data[processor_at] == 86 else "<"
    markers, analog, first, last = struct.unpack_from(f"{endian}4H", data, 2)
    (start,) = struct.unpack_from(f"{endian}H", data, 16)
    real = data[processor_at] in (84, 86) and struct.unpack_from(f"{endian}f", data, 12)[0] < 0.0
    frames = last - first + 1
    needed = (start - 1) * BLOCK_BYTES + max(frames, 0) * (4 * markers + analog) * (4 if real else 2)
    if frames > 0 and last < 0xFFFF and needed > len(data):
        raise _invalid(
            [f"is cut short: {len(data)} bytes, {frames} frames of {markers} markers need {needed}"]
        )
    _check_parameters(data, processor_at + 1, endian)


def _check_parameters(data: bytes, at: int, endian: str) -> None:
    """That every parameter lies in the file; the library would count one that does not to its end, for minutes.

    An entry: length and characters of its name, group, distance to the next one; of a parameter also the bytes of a
    value, how often along each of its dimensions, the values; length and characters of its description.
    """
    while at + 2 <= len(data) and data[at] != 0:
        name, group = struct.unpack_from("bb", data, at)
        at += 2 + abs(name)
        entry = data[at : at + 4]
        if len(entry) < 4:
            raise _invalid([f"is cut short: {len(data)} bytes, within a parameter's name"])
        (distance,) = struct.unpack_from(f"{endian}H", entry)
        end, counted = at + 2, 0
        if group >= 0:
            size, counts = abs(struct.unpack_from("b", entry, 2)[0]), data[at + 4 : at + 4 + entry[3]]
            end += 2 + entry[3] + size * math.prod(counts)
            counted = math.prod(max(1, count) for count in counts)
        described = data[end] if max(end, counted) < len(data) else len(data)
        if described > MOST_DESCRIBED or end + described >= len(data):
            raise _invalid(
                [f"is cut short: {len(data)} bytes, a parameter at byte {at} does not end within them"]
            )
        if distance == 0:
            return
        at += distance


def _invalid(messages: list[str]) -> SceneInvalid:
    return SceneInvalid([FieldError(loc=["c3d"], msg=message) for message in messages])
