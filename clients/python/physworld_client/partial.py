"""A download that can be broken off and resumed, and that is only ever seen whole.

Bytes go to ``.<name>.<digest>.part`` beside the target. The part found there is hashed and continued with a
``Range`` request. The target appears by one rename, after the SHA-256 of the whole was seen to match.

A part belongs to one download at a time: it is locked while that lasts. Another download of the same file at the same
time, in a thread or another process, takes the next name that is free (``.<name>.<digest>.1.part`` …), waits for nobody
and puts the same bytes in place. Parts that nobody holds are removed by whoever finishes.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO

import httpx

from physworld_client.errors import DigestMismatch, PhysWorldError
from physworld_client.locks import try_lock


class PartialFile:
    """The unfinished download of one artifact, a context manager; used by both clients.

    Attributes:
        part: where the bytes go; its lock is held until the context ends.
        offset: bytes that are there.
    """

    def __init__(self, target: Path, sha256: str) -> None:
        """Raises PhysWorldError for what is no digest."""
        if len(sha256) != 64 or set(sha256) - set("0123456789abcdef"):
            raise PhysWorldError(f"{sha256!r} is not a SHA-256 digest (64 lower-case hexadecimal digits)")
        self.target = target
        self.sha256 = sha256
        self.offset = 0
        self._placed = False

    def __enter__(self) -> PartialFile:
        """Takes a part: the first that nobody else is writing."""
        self.target.parent.mkdir(parents=True, exist_ok=True)
        self.part, self._stream = self._taken()
        self.offset = self.part.stat().st_size
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Lets the part go; its bytes stay for the next attempt, an empty one does not."""
        if not self.offset and not self._placed:
            with suppress(OSError):
                self.part.unlink(missing_ok=True)
        self._stream.close()

    def present(self) -> bool:
        """Whether the target is there already with the right digest."""
        return self.target.is_file() and sha256_of(self.target) == self.sha256

    def headers(self) -> dict[str, str]:
        """Request headers that ask for what is missing, byte for byte."""
        headers = {"Accept": "*/*", "Accept-Encoding": "identity"}
        if self.offset:
            headers["Range"] = f"bytes={self.offset}-"
        return headers

    def accept(self, response: httpx.Response) -> None:
        """Prepares for the body of a success: it continues the part (206) or replaces it (200).

        Raises:
            PhysWorldError: the service answered another range than the one asked for.
        """
        if response.status_code == 206:
            header = response.headers.get("content-range", "")
            if _range_start(header) != self.offset:
                raise PhysWorldError(f"{response.url} answered {header!r} when asked from byte {self.offset}")
        else:
            self._truncate()

    def refused(self, response: httpx.Response) -> bool:
        """Whether the service refused the range (416): the part is useless, and is dropped to begin again."""
        if response.status_code != 416 or not self.offset:
            return False
        self._truncate()
        return True

    def write(self, chunk: bytes) -> None:
        """Appends bytes of the body."""
        self._stream.write(chunk)
        self.offset += len(chunk)

    def finish(self) -> Path:
        """Checks the whole and puts it in place; a wrong part is removed.

        Raises:
            DigestMismatch: the bytes are not the ones that the digest promises.
        """
        self._stream.flush()
        found = sha256_of(self.part)
        if found != self.sha256:
            self._truncate()
            raise DigestMismatch(str(self.target), self.sha256, found)
        os.fsync(self._stream.fileno())
        if os.name == "nt":  # no open file is renamed there
            self._stream.close()
        self.part.replace(self.target)
        self._placed = True
        self._remove_others()
        return self.target

    def complete(self) -> bool:
        """Whether the part found on disk is the whole already (broken off just before the rename)."""
        self._stream.flush()
        return self.offset > 0 and sha256_of(self.part) == self.sha256

    def _taken(self) -> tuple[Path, IO[bytes]]:
        number = 0
        while (stream := _held(self._place(number))) is None:
            number += 1
        return self._place(number), stream

    def _place(self, number: int) -> Path:
        order = f".{number}" if number else ""
        return self.target.with_name(f".{self.target.name}.{self.sha256[:16]}{order}.part")

    def _truncate(self) -> None:
        self._stream.flush()
        self._stream.truncate(0)
        self.offset = 0

    def _remove_others(self) -> None:
        """Removes the parts that broken downloads left; one that is being written stays."""
        start = f".{self.target.name}.{self.sha256[:16]}."
        for place in self.target.parent.iterdir():
            if place.name.startswith(start) and place.suffix == ".part":
                stream = _held(place)
                if stream is not None:
                    with stream, suppress(OSError):
                        place.unlink(missing_ok=True)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _held(place: Path) -> IO[bytes] | None:
    """The part, locked, and made where there is none; None while somebody else writes it."""
    while True:
        stream = place.open("ab")
        if not try_lock(stream):
            stream.close()
            return None
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(stream.fileno()), place.stat()):
                return stream
        stream.close()  # whoever held it has put it in place, or removed it: there is a new one


def _range_start(header: str) -> int | None:
    """The first byte of ``Content-Range: bytes 5-9/10``."""
    unit, _, rest = header.partition(" ")
    start = rest.partition("-")[0]
    return int(start) if unit == "bytes" and start.isdigit() else None
