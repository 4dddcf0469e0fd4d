"""Import of C3D motion capture: markers on the object, and markers that are driven or clamped.

Units come from POINT:UNITS, the rate from POINT:RATE. A sample whose residual is negative or which is not a
number is a gap: it is filled in by interpolation and marked invisible. Which markers are controllers is not
in the file: labels that begin with ``base``, ``clamp``, ``ctrl``, ``grip`` or ``robot``, or those named in
the options. ``up`` says which axis of the recording points up.

The file is parsed by ezc3d in a child process with limited memory: a forged file can at most end that child. A process
that is such a child itself says so by ``limit_here``, and parses the file without another.
"""

from __future__ import annotations

import json
import math
import re
import struct
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.scene import Scene
from physworld_scenes.archives import ArchiveRefused, read_arrays
from physworld_scenes.bundle import checked, scene_from_parts
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers.axes import ROTATION_FROM_UP
from physworld_scenes.importers.c3d_child import content_of
from physworld_scenes.importers.options import Importer, ImportOptions, estimate_noise, split_of
from physworld_schemas.base import FieldError
from physworld_schemas.wording import reason

DEFAULT_KIND = "blob"
CONTROLLER_LABEL = re.compile(r"^(.*:)?(base|clamp|ctrl|control|grip|robot)", re.IGNORECASE)
"""A label of a controller; motion capture puts the subject and a colon before the name."""

METRES_PER_UNIT = {
    "m": 1.0,
    "meters": 1.0,
    "metres": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "millimeters": 1e-3,
    "in": 0.0254,
}

C3D_MAGIC = 0x50
BLOCK_BYTES = 512
MOST_DESCRIBED = 127
"""Characters of a description: the library takes the byte that counts them for one with a sign."""
CHILD_SECONDS = 120.0
GAP_WARNING = 0.1


@dataclass(frozen=True)
class Recording:
    """What the file holds: marker positions (T, N, 3) in ``unit``, validity (T, N), labels, rate [Hz]."""

    positions: Array
    valid: Array
    labels: list[str]
    unit: str
    rate_hz: float


def is_c3d(data: bytes) -> bool:
    """Whether the bytes begin like a C3D file."""
    return len(data) >= BLOCK_BYTES and data[1] == C3D_MAGIC and 2 <= data[0] <= 64


def read(source: Path | str | bytes, options: ImportOptions | None = None) -> Scene:
    """The scene in a C3D file (a path, or its bytes).

    Raises:
        SceneInvalid: with every fault.
    """
    if not isinstance(source, bytes):
        path = Path(source)
        return read_bytes(path.read_bytes(), path.stem, options)[0]
    return read_bytes(source, "recording", options)[0]


def read_bytes(data: bytes, name: str, options: ImportOptions | None = None) -> tuple[Scene, list[str]]:
    """The scene in the bytes of a C3D file, and its warnings; ``name`` unless the options have one."""
    options = options or ImportOptions()
    recording = parse(data)
    scale, rotation = _scale(recording), _rotation(options.up)
    positions = recording.positions * scale @ rotation.T
    driven = _controllers(recording.labels, options.controllers)
    tracked = [i for i in range(len(recording.labels)) if i not in driven]
    faults = []
    if not tracked:
        faults.append(f"all {len(driven)} markers are controllers; none is left on the object")
    absent = [recording.labels[i] for i in driven if not recording.valid[:, i].any()]
    if absent:
        faults.append(f"controllers never seen: {', '.join(absent)}")
    if recording.rate_hz <= 0.0 or not np.isfinite(recording.rate_hz):
        faults.append(f"POINT:RATE is {recording.rate_hz:g} Hz")
    if len(positions) < 2:
        faults.append(f"has {len(positions)} frames; a motion needs 2 or more")
    if faults:
        raise _invalid(faults)
    filled = fill_gaps(positions, recording.valid)
    points, visible = filled[:, tracked], recording.valid[:, tracked]
    gaps = ~recording.valid[:, driven]
    noise = options.noise_sigma_m or estimate_noise(points, visible)
    declared = {
        "schema_version": 1,
        "name": options.name or name,
        "kind": options.kind or DEFAULT_KIND,
        "description": "imported from C3D motion capture",
        "fps": recording.rate_hz,
        "gravity_m_s2": list(options.gravity_m_s2),
        "noise_sigma_m": noise,
        "split": split_of(len(points)),
        "initial_state": "as measured",
        "body": dict(options.body),
        "ground": None,
        "grips": None,
        "notes": {
            "source": {"format": "C3D", "unit": recording.unit, "up": options.up},
            "point_labels": [recording.labels[i] for i in tracked],
            "controller_labels": [recording.labels[i] for i in driven],
            "noise": "given" if options.noise_sigma_m else "upper estimate from third differences",
            "controller_samples_interpolated": int(gaps.sum()),
        },
    }
    stored = {
        "points": points,
        "visible": visible,
        "controllers": filled[:, driven],
        "times": np.arange(len(points)) / recording.rate_hz,
    }
    scene, warnings = checked(scene_from_parts(declared, stored))
    if gaps.mean() > GAP_WARNING:
        warnings.append(f"controllers: {gaps.mean():.0%} of the samples are gaps, filled in by interpolation")
    return scene, warnings


_limited_here = False


def limit_here() -> None:
    """This process is one that a forged file may end: parse in it."""
    global _limited_here
    _limited_here = True


def parse(data: bytes) -> Recording:
    """Markers of a C3D file.

    Raises:
        SceneInvalid: it is no C3D file, it is cut short, or it cannot be parsed.
    """
    _check_header(data)
    with tempfile.TemporaryDirectory(prefix="physworld-c3d-") as folder:
        source = Path(folder) / "recording.c3d"
        source.write_bytes(data)
        positions, residuals, header = _parsed_here(source) if _limited_here else _parsed_in_child(source)
    valid = (residuals >= 0.0) & np.isfinite(residuals) & np.isfinite(positions).all(axis=2)
    positions = np.where(valid[..., None], positions, 0.0)
    return Recording(positions, valid, header["labels"], header["unit"], float(header["rate_hz"]))


def _parsed_here(source: Path) -> tuple[Array, Array, dict[str, Any]]:
    try:
        return content_of(str(source))
    except (MemoryError, KeyError, IndexError, TypeError, ValueError, OSError, RuntimeError) as error:
        raise _invalid([f"cannot be read: {reason(error)[:200]}"]) from error


def _parsed_in_child(source: Path) -> tuple[Array, Array, dict[str, Any]]:
    target = source.with_suffix(".npz")
    command = [sys.executable, "-m", "physworld_scenes.importers.c3d_child", str(source), str(target)]
    try:
        child = subprocess.run(
            command, cwd=Path(__file__).parents[2], capture_output=True, timeout=CHILD_SECONDS, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise _invalid([f"reading it took more than {CHILD_SECONDS:.0f} s"]) from error
    if child.returncode != 0 or not target.is_file():
        lines = child.stderr.decode(errors="replace").strip().splitlines()
        reason = lines[-1][:200] if lines else f"exit status {child.returncode}"
        raise _invalid([f"cannot be read: {reason}"])
    try:
        arrays = read_arrays(target.read_bytes())
    except ArchiveRefused as error:
        raise _invalid([f"cannot be read: {error}"]) from error
    return arrays["positions"], arrays["residuals"], json.loads(child.stdout)


def fill_gaps(positions: Array, valid: Array) -> Array:
    """Positions (T, N, 3) with every gap interpolated in time, held at the ends; zero if never seen."""
    filled = np.zeros_like(positions)
    frames = np.arange(len(positions))
    for i in range(positions.shape[1]):
        known = valid[:, i]
        if known.any():
            for axis in range(3):
                filled[:, i, axis] = np.interp(frames, frames[known], positions[known, i, axis])
    return filled


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


def _scale(recording: Recording) -> float:
    unit = recording.unit.strip().lower()
    if unit not in METRES_PER_UNIT:
        raise _invalid([f"POINT:UNITS is {recording.unit!r}; known are {', '.join(METRES_PER_UNIT)}"])
    return METRES_PER_UNIT[unit]


def _rotation(up: str) -> Array:
    if up not in ROTATION_FROM_UP:
        raise _invalid([f"up is {up!r}; known are {', '.join(ROTATION_FROM_UP)}"])
    return ROTATION_FROM_UP[up]


def _controllers(labels: list[str], named: tuple[str, ...] | None) -> list[int]:
    """Indices of the controllers, in the file's order."""
    if named is not None:
        unknown = [label for label in named if label not in labels]
        if unknown:
            raise _invalid([f"has no marker {', '.join(unknown)}; its markers are {', '.join(labels)}"])
        return [i for i, label in enumerate(labels) if label in named]
    found = [i for i, label in enumerate(labels) if CONTROLLER_LABEL.match(label)]
    if not found:
        raise _invalid(
            [
                "names no controller (a label beginning with base, clamp, ctrl, control, grip or robot);"
                f" say which of its markers are driven: {', '.join(labels)}"
            ]
        )
    return found


def _invalid(messages: list[str]) -> SceneInvalid:
    return SceneInvalid([FieldError(loc=["c3d"], msg=message) for message in messages])


IMPORTER = Importer(
    "c3d",
    "C3D motion capture",
    (".c3d",),
    "markers, in metres by POINT:UNITS; gaps are filled and invisible; controllers by their labels or options",
    lambda data, filename: is_c3d(data),
    read_bytes,
)
