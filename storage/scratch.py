"""What a job needs while it runs and nobody afterwards: ``scratch/{job}/{name}`` in the object store.

Every worker of an installation sees it, so a job that a killed worker began goes on elsewhere. A write is atomic; two
writers of one name write the same content. The folder goes with the job's end, never before its result is committed.
"""

from __future__ import annotations

import re

import obstore

from physworld_storage.errors import NotFound
from physworld_storage.settings import Settings
from physworld_storage.store import open_store, reading, writing

_JOB = re.compile(r"[A-Za-z0-9_-]{1,64}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


class ScratchStore:
    """Files of running jobs, in a local folder or a bucket."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._store = open_store(settings, uploads=True)

    def put(self, job_id: str, name: str, data: bytes) -> None:
        """Write a file. Raises StoreWriteFailed or StoreFull; nothing is then visible."""
        with writing(f"scratch file {name}", len(data), self._settings):
            obstore.put(self._store, _path(job_id, name), data)

    def get(self, job_id: str, name: str) -> bytes | None:
        """A file, or None where there is none."""
        try:
            with reading("scratch file", name, self._settings):
                return bytes(obstore.get(self._store, _path(job_id, name)).bytes())
        except NotFound:
            return None

    def has(self, job_id: str, name: str) -> bool:
        """Whether a file is there."""
        try:
            with reading("scratch file", name, self._settings):
                obstore.head(self._store, _path(job_id, name))
        except NotFound:
            return False
        return True

    def remove(self, job_id: str) -> int:
        """Remove everything of a job; how many files."""
        removed = 0
        with writing(f"the removal of scratch files of {job_id}", 0, self._settings):
            for batch in obstore.list(self._store, prefix=_folder(job_id)):
                obstore.delete(self._store, [entry["path"] for entry in batch])
                removed += len(batch)
        return removed

    def jobs(self) -> list[str]:
        """Jobs that have files."""
        with reading("scratch files", "of any job", self._settings):
            found = obstore.list_with_delimiter(self._store, prefix="scratch")["common_prefixes"]
        return [path.rstrip("/").rpartition("/")[2] for path in found]


def _folder(job_id: str) -> str:
    if not _JOB.fullmatch(job_id):
        raise ValueError(f"{job_id[:80]!r} is not the id of a job")
    return f"scratch/{job_id}"


def _path(job_id: str, name: str) -> str:
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name[:80]!r} is not the name of a scratch file")
    return f"{_folder(job_id)}/{name}"
