"""Does one shard: claim by compare-and-set, run the handler under a renewed lease, commit by compare-and-set.

A handler's failure becomes a problem document with the exception's own numbers. Physics, faulty input and
bugs fail the shard at once: they would fail again. Storage, network, memory and a full disk are tried again with the
attempts capped in the database. What a job kept in the scratch is removed once the job has ended, never before: an
attempt whose result could not be committed is gone on with.
"""

from __future__ import annotations

import functools
import importlib
import logging
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from celery.exceptions import SoftTimeLimitExceeded

from physworld.errors import Cancelled as LibraryCancelled
from physworld.errors import PhysworldError
from physworld.worldmodel.errors import WorldModelError
from physworld_schemas.base import Problem
from physworld_schemas.hints import hint_of
from physworld_schemas.job import TERMINAL_STATES
from physworld_schemas.wording import reason, words
from physworld_storage.database import Database, open_database
from physworld_storage.errors import DatabaseUnavailable, StorageError, StoreReadFailed, StoreWriteFailed
from physworld_storage.jobs import leases
from physworld_storage.jobs.kinds import SHARDS
from physworld_storage.settings import Settings, get_settings
from physworld_storage.tables import JobRow
from physworld_workers.context import Handler, HandlerResult, TaskContext
from physworld_workers.errors import Cancelled, LeaseLost, NotEnoughDisk, UnknownShardKind, WorkerError
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores

logger = logging.getLogger(__name__)

Outcome = Literal["done", "failed", "retried", "cancelled", "not committed", "not claimed"]
COMMIT_PAUSE_S = 1.0
WORTH_A_RETRY = (
    OSError,
    MemoryError,
    DatabaseUnavailable,
    StoreReadFailed,
    StoreWriteFailed,
    UnknownShardKind,
    NotEnoughDisk,
)
SAID_BY_THE_WORK = (
    PhysworldError,
    WorldModelError,
    StorageError,
    WorkerError,
    ValueError,
    SoftTimeLimitExceeded,
)


def handler_of(kind: str) -> Handler:
    """The handler of a kind of shard, its module imported now. Raises UnknownShardKind.

    Handlers are import strings, so that starting a worker imports neither ``torch`` nor ``warp``.
    """
    if kind not in SHARDS:
        raise UnknownShardKind(f"no handler for shard kind {kind!r}; this worker knows {sorted(SHARDS)}")
    module, _, function = SHARDS[kind].handler.partition(":")
    handler: Handler = getattr(importlib.import_module(module), function)
    return handler


@dataclass(frozen=True)
class Runtime:
    """What every shard of this process shares; ``abandon`` ends the process where a handler cannot be stopped."""

    settings: Settings
    database: Database
    stores: Stores
    owner: str
    handler_of: Callable[[str], Handler] = handler_of
    abandon: Callable[[], None] | None = None


@functools.cache
def process_runtime() -> Runtime:
    """The runtime of this process, opened at its first shard (never before a fork)."""
    settings = get_settings()
    database = open_database(settings)
    return Runtime(settings, database, Stores(settings, database), process_owner(), abandon=end_process)


def end_process() -> None:
    """End this pool process at once, whatever code it is in; the worker puts up another one."""
    os.kill(os.getpid(), signal.SIGKILL)


def run_shard(runtime: Runtime, shard_id: str) -> Outcome:
    """Do the shard if it can be had; a duplicate or late message ends here without effect."""
    with runtime.database.session() as session:
        lease = leases.claim(session, shard_id, runtime.owner, runtime.settings.lease_seconds)
    if lease is None:
        logger.info("shard %s: not to be had (done, cancelled or held by another)", shard_id)
        return "not claimed"
    logger.info("shard %s: %s %d, attempt %d", shard_id, lease.kind, lease.index, lease.attempt)
    started = time.monotonic()
    outcome = _run_claimed(runtime, lease)
    if SHARDS[lease.kind].keeps_scratch:
        _tidy(runtime, lease.job_id)
    logger.info("shard %s: %s after %.2f s", shard_id, outcome, time.monotonic() - started)
    return outcome


def _run_claimed(runtime: Runtime, lease: leases.Lease) -> Outcome:
    try:
        with TaskContext(lease, runtime.database, runtime.settings, runtime.abandon) as context:
            made = runtime.handler_of(lease.kind)(context, runtime.stores)
        return _commit(runtime, context, made)
    except LeaseLost as error:
        logger.warning("shard %s: %s", lease.shard_id, error)
        return "not committed"
    except (Cancelled, LibraryCancelled):
        with runtime.database.session() as session:
            ours = leases.mark_cancelled(session, lease)
        return "cancelled" if ours else "not committed"
    except SystemExit:  # SIGTERM in a pool process: the worker is being stopped
        logger.info("shard %s: given back, the worker is stopping", lease.shard_id)
        with runtime.database.session() as session:
            leases.release(session, lease)
        raise
    except WORTH_A_RETRY as error:
        logger.exception("shard %s: attempt %d failed", lease.shard_id, lease.attempt)
        return _record_failure(runtime, lease, error, retry=True)
    except SAID_BY_THE_WORK as error:
        logger.warning("shard %s: %s: %s", lease.shard_id, type(error).__name__, error)
        return _record_failure(runtime, lease, error, retry=False)
    except Exception as error:
        _record_failure(runtime, lease, error, retry=False)
        raise


def _commit(runtime: Runtime, context: TaskContext, made: HandlerResult) -> Outcome:
    """Commit the result; a database that is away is asked again while the lease lasts."""
    while True:
        try:
            with runtime.database.session() as session:
                committed = leases.complete(session, context.lease, made.result, made.digest)
            return "done" if committed else "not committed"
        except DatabaseUnavailable as error:
            if context.seconds_left() < COMMIT_PAUSE_S:
                raise
            logger.warning("shard %s: not committed yet: %s", context.lease.shard_id, error)
            time.sleep(COMMIT_PAUSE_S)


def _tidy(runtime: Runtime, job_id: str) -> None:
    """Empty the scratch of a job that has ended, unless it may be retried; else the dispatcher does it later."""
    try:
        with runtime.database.reading() as session:
            ended = session.get_one(JobRow, job_id).state in TERMINAL_STATES - {"failed"}
        if ended:
            runtime.stores.scratch.remove(job_id)
    except StorageError as error:
        logger.warning("job %s: its scratch stays for now: %s", job_id, error)


def _record_failure(runtime: Runtime, lease: leases.Lease, error: BaseException, *, retry: bool) -> Outcome:
    with runtime.database.session() as session:
        leases.fail(session, lease, problem_of(error), retry)
    return "retried" if retry else "failed"


def problem_of(error: BaseException) -> Problem:
    """The problem document of an exception: its own code if it has one, else its type in snake case."""
    return Problem(
        type=f"urn:physworld:problem:{_code(error)}",
        title=words(type(error).__name__),
        status=500 if isinstance(error, WORTH_A_RETRY) or not isinstance(error, SAID_BY_THE_WORK) else 422,
        code=_code(error),
        detail=reason(error),
        errors=list(getattr(error, "faults", [])),
        hint=getattr(error, "hint", None) or hint_of(_code(error)),
    )


def _code(error: BaseException) -> str:
    return str(getattr(error, "code", None) or words(type(error).__name__).replace(" ", "_"))
