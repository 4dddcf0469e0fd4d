"""Leases: who executes a shard, and for how long. The truth about running work is here, not in the broker.

A shard's life::

    QUEUED --claim--> RUNNING --complete--> DONE
      ^                 |  |------fail----> QUEUED (again, later) or FAILED (the job with it)
      |                 |  '--mark_cancelled--> CANCELLED
      '------reap-------'  the lease ran out: QUEUED; FAILED only where the work kills its workers

Every change is a compare-and-set on (id, epoch, state). ``claim`` raises the epoch, so a worker that was
presumed dead and comes back finds that its epoch is no longer the shard's: it cannot commit, renew or fail
anything. A kill at any instant leaves the shard RUNNING until its lease ends, never half committed.
All times are of the database's clock (``physworld_storage.clock``), so hosts whose clocks are wrong do no harm.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any, Literal, cast

from sqlalchemy import CursorResult, case, func, or_, select, update
from sqlalchemy.orm import Session

from physworld_schemas.base import Problem
from physworld_schemas.job import TERMINAL_STATES, Progress
from physworld_storage.changes import announce
from physworld_storage.clock import database_now
from physworld_storage.errors import NotFound
from physworld_storage.jobs import losses
from physworld_storage.jobs.flow import (
    fail_job,
    heard_from,
    report_progress,
    settle_cancel,
    shard_started,
    shard_succeeded,
)
from physworld_storage.jobs.kind import Tells
from physworld_storage.jobs.kinds import SHARDS, parse_result
from physworld_storage.jobs.shards import CANCELLED, DONE, FAILED, QUEUED, RUNNING, lock_job
from physworld_storage.tables import JobRow, ShardRow

BACKOFF_SECONDS = 1.0  # before the second attempt; doubles with each further one
BACKOFF_LIMIT_SECONDS = 60.0
REPUBLISH_SECONDS = 60.0
OPEN_STATES = ("queued", "running")  # of a job whose shards may be claimed
WINDOW = 256  # messages of one queue in the broker at a time; more would only be duplicates after a loss

LeaseState = Literal["held", "lost", "cancel"]


@dataclass(frozen=True)
class Lease:
    """The right to execute one shard; ``epoch`` is its fencing token, ``attempt`` counts from 1."""

    shard_id: str
    job_id: str
    kind: str
    epoch: int
    attempt: int
    index: int
    payload: dict[str, Any] = field(hash=False)


@dataclass(frozen=True)
class Publication:
    """A shard to announce to the broker: the message on ``queue`` carries ``shard_id`` and nothing else."""

    shard_id: str
    queue: str
    kind: str
    epoch: int


def claim(session: Session, shard_id: str, owner: str, lease_seconds: float) -> Lease | None:
    """Take a queued shard, or None: somebody has it, it is done, called off, or must not start yet.

    Args:
        session: the transaction that it belongs to.
        shard_id: as announced by the dispatcher.
        owner: of the lease: the worker's name, for people.
        lease_seconds: how long the lease holds without being renewed [s].
    """
    seen = session.execute(
        select(ShardRow.job_id, ShardRow.state, ShardRow.epoch).where(ShardRow.id == shard_id)
    ).one_or_none()
    if seen is None or seen.state != QUEUED:
        return None
    job = lock_job(session, seen.job_id)
    if job.state not in OPEN_STATES:
        return None
    now = database_now(session)
    taken = _changed(
        session,
        update(ShardRow)
        .where(
            ShardRow.id == shard_id,
            ShardRow.epoch == seen.epoch,
            ShardRow.state == QUEUED,
            or_(ShardRow.not_before.is_(None), ShardRow.not_before <= now),
        )
        .values(
            state=RUNNING,
            epoch=ShardRow.epoch + 1,
            attempt=ShardRow.attempt + 1,
            lease_owner=owner,
            lease_until=now + timedelta(seconds=lease_seconds),
            claimed_at=now,
            renewed_at=now,
            progress=None,
        ),
    )
    if not taken:
        return None
    shard = _shard(session, shard_id)
    shard_started(session, job, shard.attempt, now)
    return Lease(
        shard_id=shard.id,
        job_id=shard.job_id,
        kind=shard.kind,
        epoch=shard.epoch,
        attempt=shard.attempt,
        index=shard.index,
        payload=shard.payload,
    )


def renew(
    session: Session, lease: Lease, lease_seconds: float, progress: Progress | None = None
) -> LeaseState:
    """Prolong a lease and report progress.

    "held": carry on. "cancel": stop, then ``mark_cancelled``. "lost": stop at once and write nothing more.

    Args:
        session: the transaction that it belongs to.
        lease: from ``claim``.
        lease_seconds: how long it holds from now [s].
        progress: how far the shard is; None reports only that its worker lives.
    """
    job = lock_job(session, lease.job_id)
    now = database_now(session)
    prolonged = {} if job.state == "cancelling" else {"lease_until": now + timedelta(seconds=lease_seconds)}
    reached = {} if progress is None else {"progress": progress.model_dump(mode="json")}
    if not _compare_and_set(session, lease, renewed_at=now, **prolonged, **reached):
        return "lost"
    heard_from(session, job, now)
    if job.state == "cancelling":
        return "cancel"
    if progress is not None and SHARDS[lease.kind].progress is Tells.ITS_OWN:
        report_progress(session, job, progress, SHARDS[lease.kind].span, now)
    return "held"


def complete(session: Session, lease: Lease, result: dict[str, Any], digest: str | None = None) -> bool:
    """Commit a shard's result with everything that follows from it; False: it was not committed.

    False means that the lease was lost or the job is being cancelled: what was written for this attempt
    belongs to nobody.

    Args:
        session: the transaction that it belongs to.
        lease: from ``claim``.
        result: what the shard's kind parses as its ``result``.
        digest: SHA-256 of what was written, where one file stands for it.

    Raises:
        ResultInvalid: the result is of the wrong form; nothing was changed.
    """
    parsed = parse_result(lease.kind, lease.index, result)
    job = lock_job(session, lease.job_id)
    now = database_now(session)
    if job.state == "cancelling":
        mark_cancelled(session, lease)
        return False
    values = {"state": DONE, "result": result, "digest": digest, "finished_at": now, "error": None}
    if not _compare_and_set(session, lease, **values, lease_owner=None, lease_until=None):
        return False
    shard_succeeded(session, job, _shard(session, lease.shard_id), parsed, now)
    return True


def fail(session: Session, lease: Lease, problem: Problem, retry: bool) -> LeaseState:
    """An attempt went wrong: queue the shard again, later, or fail the job with the problem.

    It is queued again when ``retry`` and it failed fewer than ``max_attempts`` times; losses do not count. Returns
    "lost" when the lease was no longer ours, "cancel" when the job was being cancelled (the shard then is),
    else "held".

    Args:
        session: the transaction that it belongs to.
        lease: from ``claim``.
        problem: what went wrong, as the API tells it.
        retry: whether another attempt may succeed.
    """
    job = lock_job(session, lease.job_id)
    now = database_now(session)
    if job.state == "cancelling":
        return "cancel" if mark_cancelled(session, lease) else "lost"
    error = problem.model_dump(mode="json")
    if not _compare_and_set(session, lease, error=error, lease_owner=None, lease_until=None):
        return "lost"
    shard = _shard(session, lease.shard_id)
    shard.failures += 1
    if retry and shard.failures < shard.max_attempts:
        wait = min(BACKOFF_LIMIT_SECONDS, BACKOFF_SECONDS * 2 ** (shard.failures - 1))
        _requeue(shard, not_before=now + timedelta(seconds=wait))
    else:
        if retry:
            reason = problem.detail or problem.title
            counted = f"attempt {shard.failures} of {shard.max_attempts} failed: {reason}"
            problem = problem.model_copy(update={"detail": counted})
        _fail_shard(session, job, shard, problem, now)
    session.flush()
    return "held"


def mark_cancelled(session: Session, lease: Lease) -> bool:
    """The worker has stopped because of a cancel; False when the lease was lost meanwhile."""
    job = lock_job(session, lease.job_id)
    now = database_now(session)
    values = {"state": CANCELLED, "lease_owner": None, "lease_until": None, "finished_at": now}
    if not _compare_and_set(session, lease, **values):
        return False
    settle_cancel(session, job, now)
    return True


def release(session: Session, lease: Lease) -> bool:
    """Give a shard back untried (the worker is shutting down): queued at once, the attempt does not count."""
    job = lock_job(session, lease.job_id)
    if job.state == "cancelling":
        return mark_cancelled(session, lease)
    if not _compare_and_set(session, lease, attempt=lease.attempt - 1):
        return False
    _requeue(_shard(session, lease.shard_id), not_before=None)
    announce(session)
    return True


def publishable(
    session: Session,
    limit: int = 100,
    *,
    republish_seconds: float = REPUBLISH_SECONDS,
    window: int = WINDOW,
) -> list[Publication]:
    """Queued shards of open jobs that the broker does not know, or was told of so long ago that it may have lost them.

    At most ``limit`` for each queue, oldest first, and so that at most ``window`` are announced at a time.
    A message too many is harmless: its ``claim`` finds nothing to take.

    Args:
        session: the transaction that reads.
        limit: most shards of one queue.
        republish_seconds: after which a message that nobody took counts as lost [s].
        window: most shards of one queue that the broker knows of at a time.
    """
    now = database_now(session)
    stale = now - timedelta(seconds=republish_seconds)
    fresh = func.sum(case((ShardRow.published_at > stale, 1), else_=0))
    queued, announced = Counter[str](), Counter[str]()
    claimable = (ShardRow.state == QUEUED, JobRow.state.in_(OPEN_STATES))
    counts = (
        select(ShardRow.kind, func.count(), fresh)
        .join(JobRow, JobRow.id == ShardRow.job_id)
        .where(*claimable)
        .group_by(ShardRow.kind)
    )
    for kind, count, told in session.execute(counts):
        if kind in SHARDS:
            queued[SHARDS[kind].queue] += count
            announced[SHARDS[kind].queue] += int(told)
    found: list[Publication] = []
    for queue in sorted(queued):
        room = min(limit, window - announced[queue])
        if room <= 0 or queued[queue] == announced[queue]:
            continue
        kinds = [kind.name for kind in SHARDS.values() if kind.queue == queue]
        rows = session.execute(
            select(ShardRow.id, ShardRow.kind, ShardRow.epoch)
            .join(JobRow, JobRow.id == ShardRow.job_id)
            .where(
                *claimable,
                ShardRow.kind.in_(kinds),
                or_(ShardRow.published_at.is_(None), ShardRow.published_at <= stale),
                or_(ShardRow.not_before.is_(None), ShardRow.not_before <= now),
            )
            .order_by(ShardRow.created_at, ShardRow.job_id, ShardRow.index)
            .limit(room)
        )
        found.extend(Publication(row.id, queue, row.kind, row.epoch) for row in rows)
    return found


def mark_published(session: Session, publications: Sequence[Publication]) -> None:
    """Remember that these were handed to the broker; one claimed or requeued meanwhile is left alone."""
    now = database_now(session)
    for publication in publications:
        session.execute(
            update(ShardRow)
            .where(
                ShardRow.id == publication.shard_id,
                ShardRow.epoch == publication.epoch,
                ShardRow.state == QUEUED,
            )
            .values(published_at=now)
        )


def reap(session: Session, limit: int = 100) -> list[str]:
    """Take back shards whose lease ran out: queued again, or failed where the work kills its workers. Their ids."""
    now = database_now(session)
    root = func.coalesce(JobRow.parent_id, JobRow.id)
    expired = session.execute(
        select(ShardRow.id, ShardRow.job_id)
        .join(JobRow, JobRow.id == ShardRow.job_id)
        .where(ShardRow.state == RUNNING, ShardRow.lease_until < now)
        .order_by(root, ShardRow.job_id, ShardRow.index)
        .limit(limit)
    ).all()
    reaped = []
    for shard_id, job_id in expired:
        job = lock_job(session, job_id)
        shard = _shard(session, shard_id)
        if shard.state == RUNNING and shard.lease_until is not None and shard.lease_until < now:
            _reap(session, job, shard, now)
            reaped.append(shard_id)
    return reaped


def end_leases_of(session: Session, is_gone: Callable[[str], bool]) -> int:
    """End the leases of owners that are provably dead, so that ``reap`` need not wait for them to run out.

    Returns how many shards they held.
    """
    now = database_now(session)
    running = (ShardRow.state == RUNNING, ShardRow.lease_until >= now)
    owners = session.scalars(select(ShardRow.lease_owner).where(*running).distinct())
    gone = [owner for owner in owners if owner is not None and is_gone(owner)]
    if not gone:
        return 0
    ended = update(ShardRow).where(*running, ShardRow.lease_owner.in_(gone))
    values = ended.values(lease_until=now - timedelta(seconds=1))
    return cast("CursorResult[Any]", session.execute(values)).rowcount


def recover(session: Session) -> int:
    """After a restart of the *whole* service: no former worker lives, the broker may have lost messages.

    Ends every lease (``reap`` then queues the shards again) and forgets every announcement. Returns how many
    shards were running. Only for a caller that knows that it is alone (the embedded supervisor's lock).
    """
    now = database_now(session)
    over = {"lease_until": now - timedelta(seconds=1), "claimed_at": None}  # nobody's loss: all were ended
    ended = update(ShardRow).where(ShardRow.state == RUNNING).values(over)
    count = cast("CursorResult[Any]", session.execute(ended)).rowcount
    session.execute(update(ShardRow).where(ShardRow.state == QUEUED).values(published_at=None))
    return count


def open_work(session: Session) -> tuple[bool, bool]:
    """Whether any shard is queued, and whether any runs."""
    queued, running = (
        select(ShardRow.id).where(ShardRow.state == state).exists() for state in (QUEUED, RUNNING)
    )
    found = session.execute(select(queued, running)).one()
    return bool(found[0]), bool(found[1])


def _reap(session: Session, job: JobRow, shard: ShardRow, now: datetime) -> None:
    if job.state == "cancelling" or job.state in TERMINAL_STATES:
        _end(shard, CANCELLED, now)
        session.flush()
        settle_cancel(session, job, now)
        return
    if shard.claimed_at is None:  # the whole service was stopped: nobody's loss
        _requeue(shard, not_before=None)
        session.flush()
        return
    shard.losses = lost = losses.with_this_one(shard)
    if losses.deadly(lost):
        problem = Problem(
            type="urn:physworld:problem:work_kills_its_workers",
            title="The work kills its workers",
            status=500,
            code="work_kills_its_workers",
            detail=f"{shard.kind} shard {shard.index} was {losses.told(lost)}",
            hint="The worker's log or the kernel's says whether it was killed for want of memory. "
            "A retry of the job keeps what is stored.",
        )
        shard.error = problem.model_dump(mode="json")
        _fail_shard(session, job, shard, problem, now)
    else:
        pause_s = losses.pause_s(lost)
        _requeue(shard, not_before=now + timedelta(seconds=pause_s) if pause_s else None)
        session.flush()


def _fail_shard(session: Session, job: JobRow, shard: ShardRow, problem: Problem, now: datetime) -> None:
    _end(shard, FAILED, now)
    session.flush()
    fail_job(session, job, problem, now)


def _requeue(shard: ShardRow, not_before: datetime | None) -> None:
    shard.state = QUEUED
    shard.lease_owner = shard.lease_until = shard.published_at = None
    shard.not_before = not_before


def _end(shard: ShardRow, state: str, now: datetime) -> None:
    shard.state = state
    shard.lease_owner = shard.lease_until = None
    shard.finished_at = now


def _compare_and_set(session: Session, lease: Lease, **values: Any) -> bool:
    held = (ShardRow.id == lease.shard_id, ShardRow.epoch == lease.epoch, ShardRow.state == RUNNING)
    return _changed(session, update(ShardRow).where(*held).values(**values))


def _changed(session: Session, statement: Any) -> bool:
    result = session.execute(statement, execution_options={"synchronize_session": False})
    return cast("CursorResult[Any]", result).rowcount == 1


def _shard(session: Session, shard_id: str) -> ShardRow:
    row = session.get(ShardRow, shard_id, populate_existing=True)
    if row is None:
        raise NotFound("shard", shard_id)
    return row
