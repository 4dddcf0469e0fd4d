"""Import of marker tracks as arrays: an npz, or the datasets of an HDF5 file.

Tracks are an array of three dimensions (frames, markers and 3, in any order), an array (frames, 3) of one marker, or
(frames, 3 markers) with names. Beside them, by their names: times, the frame rate, the markers' names, what is seen,
unit, up. Two arrays of three dimensions are two sets, named as the arrays are; one that is called after a controller
or a gripper drives.
"""

from __future__ import annotations

import re

import numpy as np

from physworld.arrays import Array
from physworld_scenes.archives import DEFAULT_LIMITS, ArchiveLimits, ArchiveRefused, is_zip, read_arrays
from physworld_scenes.importers.tables.table import (
    MarkerTable,
    checked_labels,
    checked_places,
    checked_size,
    checked_times,
    named,
    refused,
    sets_by_prefix,
    shortened,
    unit_of,
)

FORM = "npz"
TIMES = re.compile(r"^(t|times?|times?_s|timestamps?|seconds|clock)$")
RATES = re.compile(r"^(fps|rate|rate_hz|frame_?rate|frequency|freq|sampling_?rate|fs)$")
NAMES = re.compile(r"^(labels?|names?|marker_?(names|labels)|markers|point_?(names|labels))$")
SEEN = re.compile(r"^(visible|visibility|valid|seen|mask|observed)$")
UNITS = re.compile(r"^(units?|length_?units?)$")
UPS = re.compile(r"^(up|up_?axis|vertical)$")
MAIN = re.compile(
    r"^(points|positions|places|tracks|markers|trajectories|data|xyz|pos|coordinates|object_points)$"
)
LIMITS = ArchiveLimits(total_bytes=DEFAULT_LIMITS.total_bytes // 4)


def is_npz(data: bytes, filename: str) -> bool:
    """Whether a file is a zip whose first member is an array."""
    if not is_zip(data) or len(data) < 30:
        return False
    length = int.from_bytes(data[26:28], "little")
    return data[30 : 30 + length].endswith(b".npy")


def read_table(data: bytes, where: str) -> MarkerTable:
    """The tracks in an npz. Raises SceneInvalid."""
    try:
        arrays = read_arrays(data, LIMITS, text=True)
    except ArchiveRefused as error:
        raise refused(where, str(error)) from error
    return table_of(where, FORM, arrays)


def table_of(where: str, form: str, arrays: dict[str, Array]) -> MarkerTable:
    """The tracks among arrays by name; names may be paths, of which the last part counts. Raises SceneInvalid."""
    facts = _Facts(where, arrays)
    tracks = _tracks(where, arrays, facts)
    frames = len(next(iter(tracks.values())))
    labels: list[str] = []
    sets: dict[str, tuple[str, ...]] = {}
    for name, track in tracks.items():
        own = facts.labels if len(tracks) == 1 or MAIN.match(_last(name)) else None
        if own is not None and len(own) == track.shape[1]:
            members = list(own)
        else:
            members = (
                [name] if track.shape[1] == 1 else [f"{name}:{number}" for number in range(track.shape[1])]
            )
        sets[name] = tuple(members)
        labels += members
    checked_size(where, frames, len(labels))
    names = checked_labels(where, labels)
    parts = [np.asarray(track, dtype=np.float64) for track in tracks.values()]
    places = np.ascontiguousarray(parts[0]) if len(parts) == 1 else np.concatenate(parts, axis=1)
    if facts.seen is not None:
        main = next((name for name in tracks if MAIN.match(_last(name))), next(iter(tracks)))
        begin = labels.index(sets[main][0])
        if facts.seen.shape != tracks[main].shape[:2]:
            raise refused(where, f"what is seen has shape {facts.seen.shape}, {main} {tracks[main].shape}")
        places[:, begin : begin + facts.seen.shape[1]][~facts.seen] = np.nan
    places, seen, said = checked_places(where, names, places)
    if facts.left:
        said.append(f"arrays left out: {named(sorted(facts.left))}")
    return MarkerTable(
        form=form,
        labels=names,
        places=places,
        seen=seen,
        times=None if facts.times is None else checked_times(where, facts.times),
        rate_hz=facts.rate_hz,
        unit=None if facts.unit is None else unit_of(facts.unit, where),
        up=facts.up,
        sets=sets_by_prefix(names) | (sets if len(sets) > 1 else {}),
        lines=tuple(said),
    )


class _Facts:
    """What arrays say that are no tracks.

    Attributes:
        times: (T,) or None.
        rate_hz, unit, up: or None.
        labels: of the markers, or None.
        seen: (T, N) bool, or None.
        left: names of arrays that say nothing here.
    """

    def __init__(self, where: str, arrays: dict[str, Array]) -> None:
        self.times: Array | None = None
        self.rate_hz: float | None = None
        self.unit: str | None = None
        self.up: str | None = None
        self.labels: list[str] | None = None
        self.seen: Array | None = None
        self.left: list[str] = []
        for name, array in arrays.items():
            key = _last(name).lower()
            text, number = array.dtype.kind in "US", array.dtype.kind in "fiu"
            if TIMES.match(key) and number and array.ndim == 1:
                self.times = array.astype(np.float64)
            elif RATES.match(key) and number and array.size == 1:
                self.rate_hz = _rate(where, name, float(array.reshape(-1)[0]))
            elif NAMES.match(key) and text and array.ndim == 1:
                self.labels = [_word(item) for item in array]
            elif UNITS.match(key) and text and array.size == 1:
                self.unit = _word(array.reshape(-1)[0])
            elif UPS.match(key) and text and array.size == 1:
                self.up = _word(array.reshape(-1)[0]).lower()
            elif SEEN.match(key) and array.ndim == 2 and array.dtype.kind in "bui":
                self.seen = array != 0
            elif not (
                number and (array.ndim == 3 or (array.ndim == 2 and array.shape[1] % 3 == 0 and array.size))
            ):
                self.left.append(name)


def _tracks(where: str, arrays: dict[str, Array], facts: _Facts) -> dict[str, Array]:
    """The arrays of tracks, each (T, N, 3), all of one length in time."""
    cubes = {name: a for name, a in arrays.items() if a.dtype.kind in "fiu" and a.ndim == 3}
    flat = {
        name: a
        for name, a in arrays.items()
        if a.dtype.kind in "fiu"
        and a.ndim == 2
        and a.size
        and a.shape[1] % 3 == 0
        and not SEEN.match(_last(name).lower())
    }
    frames = None if facts.times is None else len(facts.times)
    found = {name: _in_order(where, name, a, frames, facts) for name, a in cubes.items()}
    if not found:
        for name, a in flat.items():
            count = a.shape[1] // 3
            if (
                a.shape[1] == 3
                or (facts.labels is not None and len(facts.labels) == count)
                or MAIN.match(_last(name))
            ):
                found[name] = a.reshape(len(a), count, 3)
    else:
        facts.left += flat
    if not found:
        shapes = ", ".join(f"{shortened(name)} {a.shape}" for name, a in list(arrays.items())[:8])
        raise refused(
            where, f"holds no tracks, of shape (frames, markers, 3); it holds {shapes or 'nothing'}"
        )
    length = frames if frames is not None else max(len(track) for track in found.values())
    other = [name for name, track in found.items() if len(track) != length]
    if other and (frames is None or len(other) == len(found)):
        shapes = ", ".join(f"{shortened(name)} {found[name].shape}" for name in found)
        raise refused(where, f"the tracks have not all {length} frames: {shapes}")
    for name in other:
        facts.left.append(name)
        del found[name]
    return found


def _in_order(where: str, name: str, array: Array, frames: int | None, facts: _Facts) -> Array:
    """An array of three dimensions as (T, N, 3)."""
    axes = [axis for axis in range(3) if array.shape[axis] == 3]
    if not axes:
        raise refused(where, f"{shortened(name)} has shape {array.shape}; one of three dimensions must be 3")
    xyz = axes[-1]
    others = [axis for axis in range(3) if axis != xyz]
    count = None if facts.labels is None else len(facts.labels)
    first, second = array.shape[others[0]], array.shape[others[1]]
    turned = (frames == second and frames != first) or (frames is None and count == first and count != second)
    time, marker = (others[1], others[0]) if turned else (others[0], others[1])
    return array.transpose(time, marker, xyz)


def _last(name: str) -> str:
    return name.rpartition("/")[2]


def _word(item: object) -> str:
    return item.decode("utf-8", errors="replace") if isinstance(item, bytes) else str(item)


def _rate(where: str, name: str, value: float) -> float:
    if not (np.isfinite(value) and value > 0.0):
        raise refused(where, f"{shortened(name)} is {value:g}; a frame rate is positive")
    return value
