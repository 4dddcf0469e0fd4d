"""What a handler holds while it works: the lease, kept alive by a thread, and the way to report and to stop.

A handler is ``run(context: TaskContext, stores: Stores) -> HandlerResult``, named by its kind of shard
(``physworld_storage.jobs.kind.ShardKind``).

The thread renews the lease about every second (sooner when there is new progress) and reads from the
same transaction whether the job was cancelled or the lease lost. A handler calls ``progress`` and ``check``
as often as it likes: both only touch memory.

A handler that is cancelled or has lost its lease has ``GRACE_S`` to notice. One that is inside code that cannot be
asked (a compiler, an export) is then left behind: the thread ends the shard as cancelled, so that whatever the handler
still makes belongs to nobody, and calls ``abandon``, by which a worker's process ends itself (ADR 47).

A database that does not answer costs the lease once ``lease_seconds`` have passed since the last renewal, by this
process's own monotonic clock, so a paused process stops by itself.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any

from physworld_schemas.job import Progress
from physworld_storage.database import Database
from physworld_storage.errors import DatabaseUnavailable
from physworld_storage.jobs import leases
from physworld_storage.settings import Settings
from physworld_workers.errors import Cancelled, LeaseLost
from physworld_workers.pace import Pace

if TYPE_CHECKING:
    from physworld_workers.stores import Stores

logger = logging.getLogger(__name__)

OPEN: set[TaskContext] = set()
"""The leases that this process holds: a shard that decides takes its own helpers."""

RENEW_INTERVAL_S = 1.0
PROGRESS_INTERVAL_S = 0.5
GRACE_S = 1.5
"""From the moment that a process knows of a cancellation to the one when it no longer waits for its handler."""
JOIN_S = 5.0
"""That the end of a task waits for a renewal under way, which may wait for a silent database."""


@dataclass(frozen=True)
class HandlerResult:
    """What a shard came to: a JSON-able result, and the digest of what it wrote (None: nothing)."""

    result: dict[str, Any] = field(default_factory=dict)
    digest: str | None = None


Handler = Callable[["TaskContext", "Stores"], HandlerResult]


class TaskContext:
    """A lease under renewal; use as a context manager around the handler.

    Args:
        lease: of the shard.
        database: where it is renewed.
        settings: of the worker.
        abandon: ends the process, once a handler that should stop has not returned within ``GRACE_S``; None: it is
            waited for.
    """

    def __init__(
        self,
        lease: leases.Lease,
        database: Database,
        settings: Settings,
        abandon: Callable[[], None] | None = None,
    ) -> None:
        self.lease = lease
        self._abandon = abandon
        self.database = database
        self.settings = settings
        self._interval_s = min(RENEW_INTERVAL_S, settings.lease_seconds / 4)
        self._stage = ""
        self._pending: dict[str, Progress] = {}
        self._pace = Pace()
        self._lock = threading.Lock()
        self._fresh = threading.Event()
        self._stop = threading.Event()
        self._cancelled = False
        self._lost = False
        self._renewed_at = time.monotonic()
        self._thread = threading.Thread(target=self._beat, name=f"lease-{lease.shard_id}", daemon=True)

    def __enter__(self) -> TaskContext:
        OPEN.add(self)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        OPEN.discard(self)
        self._stop.set()
        self._fresh.set()
        self._thread.join(JOIN_S)  # a renewal that hangs writes nothing that the epoch does not allow

    def plan(self, weights: Mapping[str, float]) -> None:
        """Say which stages the shard goes through, in their order, and about how long each takes (in one unit)."""
        self._pace.plan(weights)

    def begin(self, stage: str, unit: str = "", total: float = 1.0, usual: float | None = None) -> None:
        """A stage of the plan begins, of which ``progress`` tells from now on. Raises Cancelled, LeaseLost.

        Args:
            stage: of the plan.
            unit: what is counted.
            total: how much there is to do.
            usual: with how much the stage ends as a rule, where the total is a budget; None: with all of it.
        """
        self.check()
        self._pace.begin(stage, usual)
        self._stage = stage
        self.progress(0, total, unit, stage)

    def progress(
        self,
        done: float,
        total: float,
        unit: str = "",
        message: str = "",
        figures: Mapping[str, float] | None = None,
    ) -> None:
        """Report how far the stage is, and so the shard.

        The newest report of every stage is written to the database, at most twice a second and when the handler ends.

        Args:
            done: how much of the stage is done.
            total: of how much.
            unit: what is counted.
            message: what is being done.
            figures: the newest figures of the work, finite ones.
        """
        share = self._pace.reach(done, total)
        told = Progress(done=done, total=total, unit=unit, message=message, fraction=share)
        told.figures = {name: value for name, value in (figures or {}).items() if math.isfinite(value)}
        with self._lock:
            self._pending[self._stage] = told
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
        while True:
            self._fresh.wait(self._interval_s)
            if self._stop.is_set():
                break
            self._fresh.clear()
            self._tell()
            if (self._cancelled or self._lost) and self._abandon is not None:
                if not self._stop.wait(GRACE_S):
                    self._leave_behind(self._abandon)
                return
            if self._lost:
                return
            self._stop.wait(min(PROGRESS_INTERVAL_S, self._interval_s))
        if self._pending:
            self._tell()

    def _tell(self) -> None:
        """Renew the lease with what was reported since the last time."""
        with self._lock:
            pending, self._pending = self._pending, {}
        try:
            for progress in pending.values() or (None,):
                self._renew(progress)
        except DatabaseUnavailable as error:
            logger.warning("lease %s not renewed: %s", self.lease.shard_id, error)

    def _leave_behind(self, abandon: Callable[[], None]) -> None:
        """End every shard that this process holds, and then the process."""
        for context in (*OPEN,):
            logger.warning(
                "shard %s: no longer wanted, and its handler does not stop", context.lease.shard_id
            )
            try:
                with self.database.session() as session:
                    leases.mark_cancelled(session, context.lease)
            except DatabaseUnavailable as error:  # the dispatcher finds the owner dead
                logger.warning("shard %s: not ended: %s", context.lease.shard_id, error)
        abandon()

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
