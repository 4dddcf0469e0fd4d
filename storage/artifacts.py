"""Content-addressed files: ``artifacts/ab/<sha256>``, whose bytes never change.

A write is atomic (a reader sees the whole file or none). Putting the same bytes again writes them again: a file that
has rotted is replaced, and the time of the last write tells when somebody last put it (``physworld_storage.orphans``).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime
from pathlib import Path

import obstore

from physworld_schemas.base import Artifact
from physworld_storage.errors import ArtifactCorrupt, NotFound
from physworld_storage.patience import WORKING, Patience
from physworld_storage.settings import Settings
from physworld_storage.store import open_store, reading, writing

FOLDER = "artifacts"
CHUNK_BYTES = 1 << 20
DEFAULT_MEDIA_TYPE = "application/octet-stream"
SHA256 = re.compile(r"[0-9a-f]{64}")


class ArtifactStore:
    """Files by the SHA-256 of their bytes, in a local folder or a bucket."""

    def __init__(self, settings: Settings, patience: Patience = WORKING) -> None:
        self._settings = settings
        self._store = open_store(settings, patience=patience)
        self._uploads = open_store(settings, patience=patience, uploads=True)

    def put_bytes(self, data: bytes, name: str, media_type: str = DEFAULT_MEDIA_TYPE) -> Artifact:
        """Store ``data``. Raises StoreWriteFailed or StoreFull; nothing is then visible."""
        sha256 = hashlib.sha256(data).hexdigest()
        with writing(f"artifact {name}", len(data), self._settings):
            obstore.put(self._uploads, _key(sha256), data)
        return Artifact(name=name, sha256=sha256, size=len(data), media_type=media_type)

    def put_file(
        self, path: Path | str, name: str | None = None, media_type: str = DEFAULT_MEDIA_TYPE
    ) -> Artifact:
        """Store the file at ``path`` without holding it in memory. Its name is the file's unless given."""
        path = Path(path)
        with path.open("rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
            size = stream.tell()
        name = name or path.name
        with writing(f"artifact {name}", size, self._settings):
            obstore.put(self._uploads, _key(sha256), path)
        return Artifact(name=name, sha256=sha256, size=size, media_type=media_type)

    def open(self, sha256: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        """Bytes ``[start, end)`` in pieces; NotFound is raised here, not by the first piece.

        A whole file is checked against its digest: ArtifactCorrupt comes after the last piece.
        """
        size = self.size(sha256)
        end = size if end is None else min(end, size)
        if not 0 <= start <= end:
            raise ValueError(f"range {start} to {end} does not lie in {size} bytes")
        if start == end:  # of an empty file too, which may be one that was cut short
            return self._pieces(iter(()), sha256, whole=size == 0)
        with reading("artifact", sha256, self._settings):
            found = obstore.get(self._store, _key(sha256), options={"range": (start, end)})
            stream = found.stream(min_chunk_size=CHUNK_BYTES)
        return self._pieces(stream, sha256, whole=(start, end) == (0, size))

    def read_bytes(self, sha256: str) -> bytes:
        """The whole file, checked. Raises NotFound or ArtifactCorrupt."""
        return b"".join(self.open(sha256))

    def exists(self, sha256: str) -> bool:
        """Whether the store holds it."""
        try:
            self.size(sha256)
        except NotFound:
            return False
        return True

    def size(self, sha256: str) -> int:
        """Its size [bytes]. Raises NotFound."""
        if not SHA256.fullmatch(sha256):
            raise NotFound("artifact", sha256[:80])
        with reading("artifact", sha256, self._settings):
            return int(obstore.head(self._store, _key(sha256))["size"])

    def last_written_before(self, time: datetime) -> Iterator[str]:
        """Digests of the files whose last write, by the store's clock, lies before ``time``."""
        with reading("artifacts", "older ones", self._settings):
            for batch in obstore.list(self._store, prefix=FOLDER):
                for entry in batch:
                    sha256 = entry["path"].rpartition("/")[2]
                    if entry["last_modified"] < time and SHA256.fullmatch(sha256):
                        yield sha256

    def remove_if_written_before(self, sha256: str, time: datetime) -> bool:
        """Remove a file unless it is gone or somebody has put it since ``time``; whether it was removed."""
        try:
            with reading("artifact", sha256, self._settings):
                if obstore.head(self._store, _key(sha256))["last_modified"] >= time:
                    return False
        except NotFound:
            return False
        with writing(f"the removal of artifact {sha256}", 0, self._settings):
            obstore.delete(self._store, _key(sha256))
        return True

    def remove_unfinished(self, time: datetime) -> None:
        """Remove ``NAME#1`` of before ``time``: a killed writer leaves it in a local folder, and no list shows it."""
        folder = self._settings.store_folder
        for part in () if folder is None else (folder / FOLDER).glob("*/*#*"):
            with writing(f"the removal of {part.name}", 0, self._settings), suppress(FileNotFoundError):
                if part.stat().st_mtime < time.timestamp():
                    part.unlink()

    def _pieces(
        self, stream: obstore.BytesStream | Iterator[bytes], sha256: str, *, whole: bool
    ) -> Iterator[bytes]:
        digest = hashlib.sha256()
        with reading("artifact", sha256, self._settings):
            for piece in stream:
                data = bytes(piece)
                if whole:
                    digest.update(data)
                yield data
        if whole and digest.hexdigest() != sha256:
            raise ArtifactCorrupt(f"artifact {sha256} now has the digest {digest.hexdigest()}")


def _key(sha256: str) -> str:
    return f"{FOLDER}/{sha256[:2]}/{sha256}"
