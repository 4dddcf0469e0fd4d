"""Reading of archives that strangers send: by name, within limits, in memory or unpacked to a folder.

A zip or a tar (plain, gzip) is read member by member. Refused, each with its name and numbers: a path that
climbs out of the archive, is absolute, names a drive or is not UTF-8; a link, a device, a sparse or an encrypted
member; two members of one name, or one of none; more members or bytes than the limits, whether declared or met while
inflating; a compression ratio that only a bomb has; a truncated or damaged archive. What the standard library would
parse without a limit is counted before it does: the directory of a zip, the extension headers of a tar.

``read_arrays`` reads an ``npz`` the same way. It parses the array headers itself: numpy would allocate what
a header claims before it looks at the data, and no array of Python objects is ever decoded.
"""

from __future__ import annotations

import errno
import io
import math
import re
import stat
import struct
import tarfile
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np

from physworld.arrays import Array

GIBIBYTE = 1 << 30
MEBIBYTE = 1 << 20
CHUNK_BYTES = MEBIBYTE

ZIP_MAGIC = b"PK\x03\x04"
EMPTY_ZIP_MAGIC = b"PK\x05\x06"
GZIP_MAGIC = b"\x1f\x8b"
TAR_MAGIC_AT = 257
TAR_MAGIC = b"ustar"

_SURROGATE = re.compile("[\ud800-\udfff]")
NUMERIC_KINDS = "biuf"
TEXT_KINDS = "US"
NPY_HEADER_LIMIT = 10_000
MOST_DIMENSIONS = 8
ZIP_ENTRY_BYTES = 4096
"""Of the directory of a zip, a member, at most: names are some hundred bytes long."""
END_OF_ZIP = b"PK\x05\x06"
END_OF_ZIP_SEARCHED = 22 + 0xFFFF
TAR_BLOCK = 512
TAR_EXTENSIONS = b"xgXLK"
"""Type flags of headers that only say more of the member after them: PAX, GNU long names."""
TAR_EXTENSION_BYTES = 4096
TAR_EXTENSIONS_IN_A_ROW = 3
TAR_DIGITS = 20
"""Of the length that a PAX record begins with. Older interpreters parse longer ones for minutes: CVE-2024-6232."""


MOST_DEPTH, LONGEST_NAME = 8, 255
NO_SUCH_NAME = frozenset({errno.EEXIST, errno.EINVAL, errno.EISDIR, errno.ENAMETOOLONG, errno.ENOTDIR})
"""What a file system says of names that clash (a file that is a folder, too) or that it does not take."""


class ArchiveRefused(ValueError):
    """An archive, or a file in it, that is damaged, hostile or too large; the message says which and why."""


@dataclass(frozen=True)
class ArchiveLimits:
    """What an archive may hold.

    Attributes:
        total_bytes: sum of the inflated sizes.
        members: files and folders.
        ratio: inflated over compressed size; only asked beyond ``ratio_free_bytes``, since a mask that is
            true everywhere honestly shrinks a thousandfold.
        ratio_free_bytes: inflated size below which no ratio is asked.
    """

    total_bytes: int = GIBIBYTE
    members: int = 256
    ratio: float = 200.0
    ratio_free_bytes: int = 64 * MEBIBYTE


DEFAULT_LIMITS = ArchiveLimits()

DAMAGED = (
    zipfile.BadZipFile,
    tarfile.TarError,
    zlib.error,
    struct.error,
    EOFError,
    NotImplementedError,
    ValueError,
    OverflowError,
    RecursionError,
)
"""What the standard library raises on truncated or malformed archives."""

MALFORMED_HEADER = (
    ValueError,
    SyntaxError,
    TypeError,
    EOFError,
    RecursionError,
    MemoryError,
    tokenize.TokenError,
)
"""What numpy raises on the header of an npy file that is none."""


def is_zip(data: bytes) -> bool:
    """Whether the bytes begin like a zip."""
    return data[:4] in (ZIP_MAGIC, EMPTY_ZIP_MAGIC)


def is_tar(data: bytes) -> bool:
    """Whether the bytes begin like a tar or like anything gzipped."""
    return data[:2] == GZIP_MAGIC or data[TAR_MAGIC_AT : TAR_MAGIC_AT + len(TAR_MAGIC)] == TAR_MAGIC


def read_archive(
    data: bytes, wanted: frozenset[str], limits: ArchiveLimits = DEFAULT_LIMITS
) -> dict[str, bytes]:
    """Contents of the members whose last path component is in ``wanted``, by their full path in the archive.

    Every member's name, type and size is checked, wanted or not.

    Raises:
        ArchiveRefused: damaged, hostile, too large, or no archive at all.
    """
    with _damage_told(f"the archive of {len(data)} bytes"):
        return {
            member.name: member.content()
            for member in _members(io.BytesIO(data), len(data), limits)
            if member.name.rpartition("/")[2] in wanted
        }


def unpack(archive: Path, folder: Path, limits: ArchiveLimits = DEFAULT_LIMITS) -> int:
    """Write the files of an archive below a folder, which is empty; how many.

    Every name is checked before anything is written, and no link is ever made, so nothing lands outside.

    Args:
        archive: a zip or a tar.
        folder: is there.
        limits: on members and bytes.

    Raises:
        ArchiveRefused: damaged, hostile, too large, no archive at all, or with names that no folder takes.
        OSError: the disk is full.
    """
    size, count = archive.stat().st_size, 0
    with archive.open("rb") as raw, _damage_told(f"the archive of {size} bytes"):
        for member in _members(raw, size, limits):
            depth, longest = member.name.count("/") + 1, max(map(len, member.name.encode().split(b"/")))
            if depth > MOST_DEPTH or longest > LONGEST_NAME:
                raise ArchiveRefused(
                    f"{member.name[:80]!r} lies {depth} levels deep, the longest of its names has {longest} bytes; "
                    f"at most {MOST_DEPTH} levels and {LONGEST_NAME} bytes are unpacked"
                )
            target = folder / member.name
            try:
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("xb") as file:
                    member.copy_to(file)
            except OSError as error:
                if error.errno not in NO_SUCH_NAME:
                    raise
                raise ArchiveRefused(f"{member.name!r} cannot be written: {error.strerror}") from error
            count += 1
    return count


def read_arrays(
    data: bytes, limits: ArchiveLimits = DEFAULT_LIMITS, *, text: bool = False
) -> dict[str, Array]:
    """The numeric arrays of an ``npz``, as stored; with ``text`` its arrays of strings, too.

    Raises:
        ArchiveRefused: damaged, too large, or an array that is not plain numbers.
    """
    if not is_zip(data):
        raise ArchiveRefused(f"not an npz (it begins with {data[:8].hex(' ') or 'nothing'})")
    with _damage_told(f"the npz of {len(data)} bytes"):
        files = {
            member.name: member.content() for member in _zip_members(io.BytesIO(data), len(data), limits)
        }
    return {
        name.removesuffix(".npy"): parse_array(name, content, text=text) for name, content in files.items()
    }


@contextmanager
def _damage_told(what: str) -> Iterator[None]:
    """Turns what the readers of archives raise on damaged ones into the refusal of ``what``."""
    try:
        yield
    except ArchiveRefused:
        raise
    except DAMAGED as error:
        raise ArchiveRefused(f"{what} is damaged or truncated: {error}") from error


@dataclass(frozen=True)
class _Member:
    """A file in an archive, whose name, type and size were checked; ``open`` gives its content, once."""

    name: str
    size: int
    open: Callable[[], IO[bytes]]

    def content(self) -> bytes:
        """All of it. Raises ArchiveRefused where it is not as long as it declares."""
        with self.open() as stream:
            content = stream.read(self.size)
            self._require(len(content), stream)
        return content

    def copy_to(self, file: IO[bytes]) -> None:
        """Write it, a piece at a time. Raises ArchiveRefused where it is not as long as it declares."""
        with self.open() as stream:
            held = 0
            while piece := stream.read(min(CHUNK_BYTES, self.size - held)):
                file.write(piece)
                held += len(piece)
            self._require(held, stream)

    def _require(self, held: int, stream: IO[bytes]) -> None:
        if held != self.size or stream.read(1):
            raise ArchiveRefused(f"{self.name} declares {self.size} bytes and holds {held} or more")


def _members(raw: IO[bytes], size: int, limits: ArchiveLimits) -> Iterator[_Member]:
    """The files in a zip or a tar, in their order."""
    head = raw.read(TAR_BLOCK)
    raw.seek(0)
    if is_zip(head):
        yield from _zip_members(raw, size, limits)
    elif is_tar(head):
        yield from _tar_members(raw, size, limits, inflate=head[:2] == GZIP_MAGIC)
    else:
        raise ArchiveRefused(f"neither a zip nor a tar (it begins with {head[:8].hex(' ') or 'nothing'})")


def _zip_members(raw: IO[bytes], size: int, limits: ArchiveLimits) -> Iterator[_Member]:
    """The files in a zip, once every name and size in it was checked."""
    _check_directory(raw, size, limits)
    found: list[tuple[str, zipfile.ZipInfo]] = []
    with zipfile.ZipFile(raw) as archive:
        entries = archive.infolist()
        if len(entries) > limits.members:
            raise ArchiveRefused(f"{len(entries)} members, at most {limits.members} are allowed")
        _check_total(sum(entry.file_size for entry in entries), size, limits, "declares")
        seen: set[str] = set()
        for entry in entries:
            name = _checked_name(entry.orig_filename, seen)
            kind = stat.S_IFMT(entry.external_attr >> 16)
            if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise ArchiveRefused(f"{name} is a link or a device (mode {kind:#o}), only files are read")
            if entry.flag_bits & 0x1:
                raise ArchiveRefused(f"{name} is encrypted")
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ArchiveRefused(
                    f"{name} uses compression method {entry.compress_type}, only deflate is read"
                )
            if not entry.is_dir():
                found.append((name, entry))
        for name, entry in found:
            yield _Member(name, entry.file_size, partial(archive.open, entry))


def _tar_members(raw: IO[bytes], size: int, limits: ArchiveLimits, *, inflate: bool) -> Iterator[_Member]:
    """The files in a tar. It is read as a stream, so that nothing in it can make the reader go back."""
    metered = _MeteredStream(raw, size, limits, inflate=inflate)
    with tarfile.open(fileobj=metered, mode="r|") as archive:  # type: ignore[call-overload]
        seen: set[str] = set()
        for count, member in enumerate(archive, start=1):
            if count > limits.members:
                raise ArchiveRefused(f"more than {limits.members} members")
            name = _checked_name(member.name, seen)
            if member.issparse() or not (member.isreg() or member.isdir()):
                raise ArchiveRefused(
                    f"{name} is a link, a device or sparse (type {member.type!r}), only files are read"
                )
            if member.size < 0:
                raise ArchiveRefused(f"{name} declares {member.size} bytes")
            _check_total(member.size, size, limits, f"{name} declares")
            if not member.isdir():
                yield _Member(name, member.size, partial(_opened, archive, member, name))


def _opened(archive: tarfile.TarFile, member: tarfile.TarInfo, name: str) -> IO[bytes]:
    stream = archive.extractfile(member)
    if stream is None:
        raise ArchiveRefused(f"{name} cannot be read")
    return stream


def _check_directory(raw: IO[bytes], length: int, limits: ArchiveLimits) -> None:
    """Refuse a zip by the size that its end record claims for the directory, before anybody parses it."""
    start = max(0, length - END_OF_ZIP_SEARCHED)
    raw.seek(start)
    tail = raw.read(length - start)
    raw.seek(0)
    at = tail.rfind(END_OF_ZIP)
    if at < 0 or at + 22 > len(tail):
        raise ArchiveRefused(f"the zip of {length} bytes is damaged or truncated: it has no end record")
    entries, size = struct.unpack_from("<HI", tail, at + 10)
    allowed = limits.members * ZIP_ENTRY_BYTES
    if entries == 0xFFFF or size == 0xFFFFFFFF or entries > limits.members or size > allowed:
        raise ArchiveRefused(
            f"its directory claims {entries} members in {size} bytes, at most {limits.members} in {allowed} are allowed"
        )


class _TarHeaders:
    """Watches the headers of a tar go by, block by block, and refuses extensions that are long, many or malformed."""

    def __init__(self) -> None:
        self._to_come = 0  # bytes of the present member's content, padding included
        self._extension = b""
        self._in_a_row = 0

    def see(self, block: bytes) -> None:
        """The next 512 bytes of the archive. Raises ArchiveRefused."""
        if self._to_come > 0:
            self._to_come -= TAR_BLOCK
            if self._extension:
                self._check_record(block)
                self._extension = b""
            return
        if len(block) < TAR_BLOCK or block.count(0) == TAR_BLOCK:
            return
        kind, size = block[156:157], _octal(block[124:136])
        if kind not in (b"1", b"2", b"3", b"4", b"5", b"6"):  # links, devices and folders have no content
            self._to_come = -(-size // TAR_BLOCK) * TAR_BLOCK
        if kind and kind in TAR_EXTENSIONS:
            self._in_a_row += 1
            if size > TAR_EXTENSION_BYTES or self._in_a_row > TAR_EXTENSIONS_IN_A_ROW:
                raise ArchiveRefused(
                    f"{self._in_a_row} extension headers in a row, the last of {size} bytes: at most "
                    f"{TAR_EXTENSIONS_IN_A_ROW} of {TAR_EXTENSION_BYTES} bytes are read"
                )
            self._extension = kind
        else:
            self._in_a_row = 0

    def _check_record(self, block: bytes) -> None:
        digits = len(block) - len(block.lstrip(b"0123456789"))
        if self._extension in b"xgX" and digits > TAR_DIGITS:
            raise ArchiveRefused(f"a PAX header that begins with {digits} digits or more")


def _octal(field: bytes) -> int:
    """A number of a tar header; sizes in base 256, of members beyond 8 GiB, are none that is read."""
    text = field.split(b"\0")[0].strip()
    try:
        return int(text or b"0", 8)
    except ValueError as error:
        raise ArchiveRefused(f"a header claims a size of {field!r}") from error


class _MeteredStream:
    """A forward-only stream that inflates if asked, watches a tar's headers, and stops at the limits."""

    def __init__(self, raw: IO[bytes], size: int, limits: ArchiveLimits, *, inflate: bool) -> None:
        self._raw = raw
        self._size = size
        self._limits = limits
        self._inflater = zlib.decompressobj(wbits=31) if inflate else None
        self._pending = b""
        self._total = 0
        self._headers = _TarHeaders()
        self._unseen = b""

    def read(self, count: int) -> bytes:
        """Next ``count`` bytes, fewer at the end."""
        parts, have = [], 0
        while have < count:
            part = self._next(count - have)
            if not part:
                break
            parts.append(part)
            have += len(part)
        self._total += have
        _check_total(self._total, self._size, self._limits, "inflates to")
        content = b"".join(parts)
        unseen = self._unseen + content
        whole = len(unseen) - len(unseen) % TAR_BLOCK
        for at in range(0, whole, TAR_BLOCK):
            self._headers.see(unseen[at : at + TAR_BLOCK])
        self._unseen = unseen[whole:]
        return content

    def _next(self, count: int) -> bytes:
        if self._inflater is None:
            return self._raw.read(min(count, CHUNK_BYTES))
        while not self._inflater.eof:
            source = self._pending or self._raw.read(CHUNK_BYTES)
            part = self._inflater.decompress(source, min(count, CHUNK_BYTES))
            self._pending = self._inflater.unconsumed_tail
            if part:
                return part
            if not source:
                raise EOFError("the gzip stream ends early")
        return b""


def _checked_name(raw: str, seen: set[str]) -> str:
    """The member's path without ``./``; refuses what points outside or comes twice."""
    if _SURROGATE.search(raw):  # how tarfile keeps bytes that are not UTF-8
        raise ArchiveRefused(f"the member name {raw!r} is not UTF-8")
    if "\x00" in raw or "\\" in raw:
        raise ArchiveRefused(f"the member name {raw!r} has a backslash or a NUL")
    if raw.startswith("/") or (len(raw) > 1 and raw[1] == ":"):
        raise ArchiveRefused(f"the member {raw!r} has an absolute path")
    parts = [part for part in raw.split("/") if part not in ("", ".")]
    if ".." in parts:
        raise ArchiveRefused(f"the member {raw!r} climbs out of the archive")
    name = "/".join(parts)
    if not raw:
        raise ArchiveRefused("a member has no name")
    if name and name in seen:
        raise ArchiveRefused(f"two members are called {name!r}")
    seen.add(name)
    return name


def _check_total(total: int, packed: int, limits: ArchiveLimits, verb: str) -> None:
    if total > limits.total_bytes:
        raise ArchiveRefused(f"{verb} {total} bytes, at most {limits.total_bytes} are allowed")
    if total > limits.ratio_free_bytes and total > limits.ratio * max(packed, 1):
        raise ArchiveRefused(
            f"{verb} {total} bytes out of {packed}: {total / max(packed, 1):.0f} times,"
            f" at most {limits.ratio:.0f} times are allowed"
        )


def parse_array(name: str, content: bytes, *, text: bool = False) -> Array:
    """The array in the content of an ``npy`` file called ``name``; of strings only with ``text``.

    Raises:
        ArchiveRefused: it holds something else than plain numbers, or not as many as it claims.
    """
    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version)
        if read_header is None:
            raise ArchiveRefused(f"{name} has npy version {version[0]}.{version[1]}, 1.0 and 2.0 are read")
        shape, fortran_order, dtype = read_header(stream, max_header_size=NPY_HEADER_LIMIT)
    except MALFORMED_HEADER as error:
        raise ArchiveRefused(f"{name} is not an npy file: {error}") from error
    kinds = NUMERIC_KINDS + (TEXT_KINDS if text else "")
    if dtype.kind not in kinds or dtype.hasobject or dtype.subdtype is not None:
        raise ArchiveRefused(f"{name} holds {dtype}; only plain numbers are read, never Python objects")
    whole = all(type(length) is int and length >= 0 for length in shape)  # True is an int, and no length
    if not whole or len(shape) > MOST_DIMENSIONS:
        raise ArchiveRefused(
            f"{name} claims the shape {str(shape)[:80]}: at most {MOST_DIMENSIONS} lengths are read"
        )
    here, claimed = len(content) - stream.tell(), math.prod(shape) * dtype.itemsize
    if claimed != here:
        raise ArchiveRefused(f"{name} claims shape {shape} of {dtype}, {claimed} bytes, and holds {here}")
    flat = np.frombuffer(content, dtype=dtype, offset=stream.tell())
    return flat.reshape(shape, order="F" if fortran_order else "C").copy()


def single_folder(names: Iterator[str] | list[str], file: str) -> str:
    """The folder that holds ``file``: the archive's top, or its one top folder.

    Raises:
        ArchiveRefused: the file is missing, deeper, or there more than once.
    """
    places = [name for name in names if name.rpartition("/")[2] == file and not name.startswith("__MACOSX/")]
    if not places:
        raise ArchiveRefused(f"holds no {file}")
    if len(places) > 1:
        raise ArchiveRefused(f"holds {len(places)} files {file}: {', '.join(sorted(places)[:5])}")
    folder = places[0].rpartition("/")[0]
    if "/" in folder:
        raise ArchiveRefused(f"{file} lies at {places[0]}; it belongs at the top or in one top folder")
    return folder
