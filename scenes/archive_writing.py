"""Writing of archives whose bytes depend on their content alone, straight into a stream.

``archives.py`` reads them.
"""

from __future__ import annotations

import io
import stat
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import IO

import numpy as np

from physworld.arrays import Array


def write_arrays(arrays: dict[str, Array]) -> bytes:
    """As ``stream_arrays``, the bytes."""
    buffer = io.BytesIO()
    stream_arrays(arrays, buffer)
    return buffer.getvalue()


def write_zip(files: dict[str, bytes]) -> bytes:
    """As ``stream_zip``, the bytes."""
    buffer = io.BytesIO()
    stream_zip([Member.of(name, content) for name, content in files.items()], buffer)
    return buffer.getvalue()


@dataclass(frozen=True)
class Member:
    """A file of an archive.

    Attributes:
        name: in the archive.
        size: bytes.
        write: writes them to what it is given.
    """

    name: str
    size: int
    write: Callable[[IO[bytes]], object]

    @staticmethod
    def of(name: str, content: bytes) -> Member:
        """A file whose bytes are there."""
        return Member(name, len(content), lambda stream: stream.write(content))


def stream_arrays(arrays: dict[str, Array], stream: IO[bytes]) -> None:
    """An ``npz`` whose bytes depend on the arrays alone: sorted, stored, no timestamps; without a copy of any.

    Args:
        arrays: by name.
        stream: takes the bytes; it can seek.
    """

    def member(name: str, array: Array) -> Member:
        whole, head = np.ascontiguousarray(array), io.BytesIO()
        np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(whole))

        def write(entry: IO[bytes]) -> None:
            np.lib.format.write_array(entry, whole, version=(1, 0), allow_pickle=False)

        return Member(f"{name}.npy", head.tell() + whole.nbytes, write)

    stream_zip([member(name, array) for name, array in arrays.items()], stream)


def stream_zip(members: Iterable[Member], stream: IO[bytes]) -> None:
    """A zip whose bytes depend on names and contents alone: sorted, stored, the epoch of zip as date.

    Args:
        members: the files.
        stream: takes the bytes; it can seek.
    """
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for member in sorted(members, key=lambda member: member.name):
            entry = zipfile.ZipInfo(member.name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.create_system = 3
            entry.external_attr = (stat.S_IFREG | 0o644) << 16
            entry.file_size = member.size
            with archive.open(entry, "w") as opened:
                member.write(opened)
