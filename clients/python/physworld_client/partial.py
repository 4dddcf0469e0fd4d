"""A download that can be broken off and resumed, and that is only ever seen whole.

Bytes go to ``.<name>.<digest>.part`` beside the target. The part found there is hashed and continued with a
``Range`` request. The target appears by one rename, after the SHA-256 of the whole was seen to match.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import httpx

from physworld_client.errors import DigestMismatch, PhysWorldError


class PartialFile:
    """The unfinished download of one artifact; used by the synchronous and the asynchronous client."""

    def __init__(self, target: Path, sha256: str) -> None:
        if len(sha256) != 64 or set(sha256) - set("0123456789abcdef"):
            raise PhysWorldError(f"{sha256!r} is not a SHA-256 digest (64 lower-case hexadecimal digits)")
        self.target = target
        self.sha256 = sha256
        self.part = target.with_name(f".{target.name}.{sha256[:16]}.part")
        target.parent.mkdir(parents=True, exist_ok=True)
        self.offset = self.part.stat().st_size if self.part.exists() else 0

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
        with self.part.open("ab") as stream:
            stream.write(chunk)
        self.offset += len(chunk)

    def finish(self) -> Path:
        """Checks the whole and puts it in place; a wrong part is removed.

        Raises:
            DigestMismatch: the bytes are not the ones that the digest promises.
        """
        self.part.touch()
        found = sha256_of(self.part)
        if found != self.sha256:
            self._truncate()
            raise DigestMismatch(str(self.target), self.sha256, found)
        with self.part.open("rb") as stream:
            os.fsync(stream.fileno())
        self.part.replace(self.target)
        return self.target

    def complete(self) -> bool:
        """Whether the part found on disk is the whole already (broken off just before the rename)."""
        return self.offset > 0 and sha256_of(self.part) == self.sha256

    def _truncate(self) -> None:
        self.part.unlink(missing_ok=True)
        self.offset = 0


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _range_start(header: str) -> int | None:
    """The first byte of ``Content-Range: bytes 5-9/10``."""
    unit, _, rest = header.partition(" ")
    start = rest.partition("-")[0]
    return int(start) if unit == "bytes" and start.isdigit() else None
