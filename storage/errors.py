"""Every error that the storage raises, as one tree.

::

    StorageError                  code, and a message that carries the numbers
    ├── ConfigurationError        the settings cannot work; ``faults`` names each of them
    ├── NotFound                  no object of that kind and id
    ├── Conflict                  the object's state forbids it
    │   ├── IdempotencyMismatch   the same Idempotency-Key came with another body
    │   └── KeyEnded              a token whose key was revoked, has expired or was given another token
    ├── InvalidCursor             a ``cursor`` that no list ever gave out
    ├── ResultInvalid             a shard's result that its kind does not allow
    ├── DatabaseUnavailable       locked, full, unreachable or not migrated; the transaction did not happen
    └── StoreError                the object store
        ├── StoreWriteFailed      nothing was committed; safe to try again
        │   └── StoreFull         no space (or quota) left
        ├── StoreReadFailed       could not be reached or read
        ├── ArtifactCorrupt       stored bytes do not have their digest
        └── EpisodeCorrupt        an episode does not have its digest, or cannot be decoded
"""

from __future__ import annotations

from collections.abc import Sequence


class StorageError(Exception):
    """Root of the tree; ``code`` is stable and fit for ``Problem.code``."""

    code = "storage_error"

    @property
    def told(self) -> str:
        """What anybody may be told: without addresses, which the message may hold."""
        return str(self)


class ConfigurationError(StorageError):
    """The settings cannot work. ``faults`` holds one sentence for each."""

    code = "configuration_invalid"

    def __init__(self, faults: Sequence[str]) -> None:
        super().__init__("; ".join(faults))
        self.faults = list(faults)


class NotFound(StorageError):
    """No ``kind`` with this ``identifier``."""

    code = "not_found"

    def __init__(self, kind: str, identifier: str) -> None:
        super().__init__(f"no {kind} {identifier}")
        self.kind = kind
        self.identifier = identifier


class Conflict(StorageError):
    """The object's present state forbids the request."""

    code = "conflict"


class IdempotencyMismatch(Conflict):
    """An Idempotency-Key that was used for another request."""

    code = "idempotency_mismatch"


class KeyEnded(Conflict):
    """A token that was a key's once and is none any more."""


class InvalidCursor(StorageError):
    """A page cursor that cannot be decoded."""

    code = "invalid_cursor"


class ResultInvalid(StorageError):
    """A handler's result that cannot be committed: a missing key, a NaN, another index."""

    code = "result_invalid"


class Unavailable(StorageError):
    """Something behind the service does not answer; the message may name it, ``told`` does not."""

    def __init__(self, message: str, told: str = "") -> None:
        super().__init__(message)
        self._told = told or message

    @property
    def told(self) -> str:
        """What anybody may be told."""
        return self._told


class DatabaseUnavailable(Unavailable):
    """The database refused or could not be reached; the transaction did not happen."""

    code = "database_unavailable"


class StoreError(StorageError):
    """Root of what the object store raises."""

    code = "store_error"


class StoreWriteFailed(StoreError, Unavailable):
    """A write failed; nothing was committed."""

    code = "store_write_failed"


class StoreFull(StoreWriteFailed):
    """A write failed because no space or quota is left."""

    code = "store_full"


class StoreReadFailed(StoreError, Unavailable):
    """A read failed for a reason other than absence."""

    code = "store_read_failed"


class ArtifactCorrupt(StoreError):
    """The stored bytes of an artifact do not hash to its name."""

    code = "artifact_corrupt"


class EpisodeCorrupt(StoreError):
    """An episode that cannot be decoded or does not have the digest that was committed."""

    code = "episode_corrupt"
