"""What h5py reads of an HDF5 file of marker tracks: every dataset of numbers or text, and the attributes that say unit,
rate, names and up.

Nothing outside of the file is read: links to other files, datasets whose values lie in other files and virtual ones are
refused, as is what unfolds to more than the limits.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from physworld.arrays import Array

MAGIC = b"\x89HDF\r\n\x1a\n"
MOST_DATASETS = 1000
MOST_BYTES = 160 << 20
MOST_CHUNK_BYTES = 32 << 20
ATTRIBUTES = (
    "unit",
    "units",
    "fps",
    "rate",
    "rate_hz",
    "frame_rate",
    "labels",
    "names",
    "marker_names",
    "up",
    "up_axis",
)


def is_hdf5(data: bytes, filename: str) -> bool:
    """Whether a file begins like HDF5."""
    return data[: len(MAGIC)] == MAGIC


def content_of(source: str) -> dict[str, Array]:
    """The arrays of an HDF5 file by their paths; attributes by the path of what they belong to.

    Raises:
        ValueError: it holds what is not read, or too much.
    """
    try:
        import h5py
    except ImportError as error:
        raise ValueError("HDF5 needs the package h5py: pip install 'physworld[tables]'") from error

    found: dict[str, Array] = {}
    total = 0
    with h5py.File(source, "r") as file:
        groups: list[tuple[str, Any]] = [("", file)]
        seen = 0
        while groups:
            path, group = groups.pop()
            _attributes(found, path, group)
            for name in group:
                seen += 1
                if seen > MOST_DATASETS:
                    raise ValueError(f"holds more than {MOST_DATASETS} groups and datasets")
                place = f"{path}/{name}".lstrip("/")
                if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                    raise ValueError(f"{place[:80]} is a link; only what lies in the file is read")
                item = group[name]
                if isinstance(item, h5py.Group):
                    if place.count("/") > 16:
                        raise ValueError(f"{place[:80]} lies deeper than 16 groups")
                    groups.append((place, item))
                    continue
                if not isinstance(item, h5py.Dataset):
                    continue
                total += _checked(place, item)
                if total > MOST_BYTES:
                    raise ValueError(f"holds {total} bytes or more, at most {MOST_BYTES} are read")
                array = _array(h5py, item)
                if array is not None:
                    found[place] = array
                    _attributes(found, place.rpartition("/")[0], item)
    return found


def _checked(place: str, item: Any) -> int:
    """Bytes of a dataset's values. Raises ValueError."""
    if item.is_virtual or item.external:
        raise ValueError(f"{place[:80]} keeps its values in other files, which are not read")
    size = int(item.dtype.itemsize)
    if item.chunks is not None and int(np.prod(item.chunks, dtype=object)) * size > MOST_CHUNK_BYTES:
        raise ValueError(f"{place[:80]} has chunks {item.chunks}, of more than {MOST_CHUNK_BYTES} bytes")
    if item.ndim > 8:
        raise ValueError(f"{place[:80]} has {item.ndim} dimensions")
    return int(np.prod(item.shape or (1,), dtype=object)) * size


def _array(h5py: Any, item: Any) -> Array | None:
    """Numbers or texts of a dataset; None for anything else."""
    if item.dtype.kind in "biuf":
        return np.asarray(item[()])
    texts = h5py.check_string_dtype(item.dtype)
    if texts is not None and item.size and item.size < 100_000:
        values = np.ravel(item.asstr(errors="replace")[()])
        return np.array([str(value)[:256] for value in values]).reshape(item.shape)
    return None


def _attributes(found: dict[str, Array], path: str, item: Any) -> None:
    for name in ATTRIBUTES:
        if name not in item.attrs:
            continue
        value = np.asarray(item.attrs[name])
        if value.dtype.kind in "OSU":
            texts = [
                v.decode("utf-8", errors="replace") if isinstance(v, bytes) else str(v)
                for v in np.ravel(value)
            ]
            value = np.array([text[:256] for text in texts]).reshape(value.shape)
        elif value.dtype.kind not in "biuf":
            continue
        found.setdefault(f"{path}/{name}".lstrip("/"), value)
