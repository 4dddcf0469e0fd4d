"""An episode as one file: a zarr group (format 3) in a ZIP that compresses nothing, which zarr's ``ZipStore`` opens.

The group is written in memory and stored in one request: there is no moment at which half of it can be seen. Small
members lie at the end, beside the ZIP's directory. A reader asks for the end, which has all headers, and then once for
each large array that it wants, so that a part of an episode is not all of it, in a bucket either. Episodes of older
datasets are folders of the same group, a file for each array and each of its headers.
"""

from __future__ import annotations

import asyncio
import io
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import obstore
import zarr
import zarr.api.asynchronous
from numpy.typing import NDArray
from zarr.codecs import BloscCodec
from zarr.core.buffer import Buffer, default_buffer_prototype
from zarr.storage import LocalStore, MemoryStore, ObjectStore

from physworld_storage.store import Store

T = TypeVar("T")

LOCAL_HEADER = struct.Struct("<4s4xH16xHH")
"""Signature, method of compression, lengths of the name and of the extra field."""
LARGE_EXTRA_BYTES = 20  # the extra field of a member of more than 2 GiB

CHUNK_BYTES = 1 << 20
PACKED_BYTES = 1 << 14
"""Smaller arrays are not compressed: it would save less than a block of the disk."""
TAIL_BYTES = 1 << 16
"""Of a file, read first: the directory (some hundred bytes an array) and small members."""


def packed(header: dict[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """The file of a group with these attributes and arrays; the same for the same values."""
    members: dict[str, Buffer] = {}
    _finish(_write_group(MemoryStore(members), header, arrays))
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name in sorted(members, key=lambda name: (-len(members[name]), name)):
            archive.writestr(zipfile.ZipInfo(name), members.pop(name).as_numpy_array().data)
    return file.getvalue()


def open_packed(store: Store, path: str) -> zarr.Group:
    """The group in the file at ``path``, whose members are read when they are asked for."""
    members = MemoryStore(_Members(store, path), read_only=True)
    return zarr.open_group(members, mode="r", zarr_format=3, use_consolidated=False)


def open_folder(place: Path | Store) -> zarr.Group:
    """The group of an older episode: a folder, or the bucket below its path."""
    store = LocalStore(place) if isinstance(place, Path) else ObjectStore(place)
    return zarr.open_group(store, mode="r", zarr_format=3, use_consolidated=False)


class _Members(MutableMapping[str, Buffer]):
    """The members of a ZIP in a store, as zarr's store in memory takes them. Raises BadZipFile for damage."""

    def __init__(self, store: Store, path: str) -> None:
        self._store, self._path = store, path
        end = obstore.get(store, path, options={"range": {"suffix": TAIL_BYTES}})
        self._tail_from, self._tail = end.range[0], bytes(end.bytes())
        # Of a ZIP without its beginning the offsets count from what there is, those before it negative.
        self._directory = zipfile.ZipFile(io.BytesIO(self._tail))

    def __getitem__(self, name: str) -> Buffer:
        """A member that is stored as it is, with its checksum."""
        member = self._directory.getinfo(name)
        most = LOCAL_HEADER.size + len(name.encode()) + LARGE_EXTRA_BYTES + member.file_size
        content = self._read(self._tail_from + member.header_offset, most)
        if len(content) < LOCAL_HEADER.size:
            raise zipfile.BadZipFile(f"{name} of {self._path} ends after {len(content)} bytes")
        signature, method, name_length, extra_length = LOCAL_HEADER.unpack_from(content)
        if signature != b"PK\x03\x04" or not method == member.compress_type == zipfile.ZIP_STORED:
            raise zipfile.BadZipFile(f"{name} of {self._path} is not a member that is stored as it is")
        begin = LOCAL_HEADER.size + name_length + extra_length
        data = content[begin : begin + member.file_size]
        if zlib.crc32(data) != member.CRC:
            raise zipfile.BadZipFile(f"{name} of {self._path} does not have its checksum")
        return default_buffer_prototype().buffer.from_array_like(np.frombuffer(data, dtype="B"))

    def _read(self, start: int, length: int) -> memoryview:
        if start >= self._tail_from:
            place = start - self._tail_from
            return memoryview(self._tail)[place : place + length]
        if start < 0:
            raise zipfile.BadZipFile(f"a member of {self._path} begins {-start} bytes before it")
        return memoryview(obstore.get_range(self._store, self._path, start=start, length=length))

    def __iter__(self) -> Iterator[str]:
        return iter(self._directory.namelist())

    def __len__(self) -> int:
        return len(self._directory.namelist())

    def __setitem__(self, name: str, value: Buffer) -> None:
        raise TypeError("an episode is never changed")

    def __delitem__(self, name: str) -> None:
        raise TypeError("an episode is never changed")


def _finish(work: Any) -> None:
    """Run ``work`` to its end on a loop of its own, in another thread where this one has a loop that runs."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        asyncio.run(work)
        return
    with ThreadPoolExecutor(max_workers=1) as thread:
        thread.submit(asyncio.run, work).result()


class _Here(ThreadPoolExecutor):
    """No pool: zarr hands every chunk of an episode to a thread, which costs more than its work."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Done at once, in the caller's thread; what it raises is raised here."""
        done: Future[T] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


async def _write_group(
    store: MemoryStore, header: dict[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Group and arrays on an event loop of this thread: zarr's own, in another one, costs half as much again."""
    asyncio.get_running_loop().set_default_executor(_Here())
    group = await zarr.api.asynchronous.create_group(store=store, attributes=header)
    for name, array in arrays.items():
        await _write_array(group, name, array)


async def _write_array(group: zarr.AsyncGroup, name: str, array: NDArray[Any]) -> None:
    """One member beside its metadata: a shard of chunks, or a chunk alone where one holds all.

    LZ4 with shuffled bytes leaves as much of floating-point tracks as zstd does, in two thirds of its time.
    """
    row = max(1, array.nbytes // max(1, array.shape[0]))
    rows = max(1, min(array.shape[0], CHUNK_BYTES // row))
    rest = tuple(max(1, length) for length in array.shape[1:])
    shards = -(-max(1, array.shape[0]) // rows) * rows
    compressed = array.nbytes >= PACKED_BYTES
    stored = await group.create_array(
        name,
        shape=array.shape,
        dtype=array.dtype,
        chunks=(rows, *rest),
        shards=(shards, *rest) if shards > rows else None,
        compressors=BloscCodec(cname="lz4", clevel=1, shuffle="shuffle") if compressed else None,
        fill_value=np.nan if array.dtype.kind == "f" else 0,  # a lost member must not read as zeros
        config={"write_empty_chunks": True},
    )
    await stored.setitem(..., array)
