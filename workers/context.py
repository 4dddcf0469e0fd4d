"""What a handler holds while it works: the lease, kept alive by a thread, and the way to report and to stop.

A handler is ``run(context: TaskContext, stores: Stores) -> HandlerResult``, named by its kind of shard
(``physworld_storage.jobs.kind.ShardKind``).

The thread renews the lease about every two seconds (sooner when there is new progress) and reads from the
same transaction whether the job was cancelled or the lease lost. A handler calls ``progress`` and ``check``
as often as it likes: both only touch memory. A database that does not answer costs the lease once
``lease_seconds`` have passed since the last renewal, by this process's own monotonic clock, so a paused
process stops by itself.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any

from physworld_schemas.job import Progress
from physworld_storage.database import Database
from physworld_storage.errors import DatabaseUnavailable
from physworld_storage.jobs import leases
from physworld_storage.settings import Settings
from physworld_workers.errors import Cancelled, LeaseLost

if TYPE_CHECKING:
    from physworld_workers.stores import Stores

logger = logging.getLogger(__name__)

RENEW_INTERVAL_S = 2.0
PROGRESS_INTERVAL_S = 0.5
JOIN_S = 5.0
"""That the end of a task waits for a renewal under way, which may wait for a silent database."""


@dataclass(frozen=True)
class HandlerResult:
    """What a shard came to: a JSON-able result, and the digest of what it wrote (None: nothing)."""

    result: dict[str, Any] = field(default_factory=dict)
    digest: str | None = None


Handler = Callable[["TaskContext", "Stores"], HandlerResult]


class TaskContext:
    """A lease under renewal; use as a context manager around the handler."""

    def __init__(self, lease: leases.Lease, database: Database, settings: Settings) -> None:
        self.lease = lease
        self.database = database
        self.settings = settings
        self._interval_s = min(RENEW_INTERVAL_S, settings.lease_seconds / 4)
        self._progress: Progress | None = None
        self._lock = threading.Lock()
        self._fresh = threading.Event()
        self._stop = threading.Event()
        self._cancelled = False
        self._lost = False
        self._renewed_at = time.monotonic()
        self._thread = threading.Thread(target=self._beat, name=f"lease-{lease.shard_id}", daemon=True)

    def __enter__(self) -> TaskContext:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._fresh.set()
        self._thread.join(JOIN_S)  # a renewal that hangs writes nothing that the epoch does not allow

    def progress(self, done: float, total: float, unit: str = "", message: str = "") -> None:
        """Report how far the shard is; written to the database at most twice a second."""
        with self._lock:
            self._progress = Progress(done=done, total=total, unit=unit, message=message)
        self._fresh.set()

    def cancelled(self) -> bool:
        """Whether the job was cancelled. Raises LeaseLost when the shard is no longer ours."""
        left_s = self.seconds_left()
        if self._lost or left_s < 0:
            late_s = self.settings.lease_seconds - left_s
            raise LeaseLost(
                f"lease on shard {self.lease.shard_id} epoch {self.lease.epoch} lost, "
                f"{late_s:.1f} s after its last renewal (lease {self.settings.lease_seconds} s)"
            )
        return self._cancelled

    def seconds_left(self) -> float:
        """How long the lease lasts unless it is renewed, by this process's own clock."""
        return self.settings.lease_seconds - (time.monotonic() - self._renewed_at)

    def check(self) -> None:
        """Raise Cancelled or LeaseLost if the handler must stop; call it every frame."""
        if self.cancelled():
            raise Cancelled(f"job {self.lease.job_id} was cancelled")

    def _beat(self) -> None:
        while not self._stop.is_set():
            self._fresh.wait(self._interval_s)
            if self._stop.is_set():
                return
            self._fresh.clear()
            with self._lock:
                progress, self._progress = self._progress, None
            try:
                self._renew(progress)
            except DatabaseUnavailable as error:
                logger.warning("lease %s not renewed: %s", self.lease.shard_id, error)
            if self._lost:
                return
            self._stop.wait(min(PROGRESS_INTERVAL_S, self._interval_s))

    def _renew(self, progress: Progress | None) -> None:
        started = time.monotonic()
        with self.database.session() as session:
            state = leases.renew(session, self.lease, self.settings.lease_seconds, progress)
        if state == "lost":
            self._lost = True
            return
        self._renewed_at = started
        if state == "cancel":
            self._cancelled = True
