"""What follows what, for every kind alike: stages of a job, children of a parent, failure and cancellation both ways.

What a kind does at each of these points is its own business (``physworld_storage.jobs.kinds``).

Everything here runs in the transaction that changes the shard, under the lock of the job and, before it, of
the job's parent (``physworld_storage.jobs.shards.lock_job``). Rows below a job are touched only under that lock, so two
workers that finish the last two episodes at the same moment start the next stage once.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import exists, select, update
from sqlalchemy.orm import Session

from physworld_schemas.base import Problem, Reference
from physworld_schemas.job import TERMINAL_STATES, Progress
from physworld_storage.clock import database_now
from physworld_storage.errors import Conflict
from physworld_storage.jobs import pace
from physworld_storage.jobs.events import append_event
from physworld_storage.jobs.kind import ShardResult, Tells
from physworld_storage.jobs.kinds import SHARDS, kind_of
from physworld_storage.jobs.progress import of_the_job
from physworld_storage.jobs.shards import CANCELLED, QUEUED, RUNNING, put_up, put_up_more
from physworld_storage.tables import JobRow, ShardRow

CANCEL_WITHIN_S = 3.0
"""From a cancellation to the end of the leases of what runs: what a worker has to stop by itself."""


def shard_started(session: Session, job: JobRow, attempt: int, now: datetime) -> None:
    """A worker took a shard: the job and its parent run.

    Args:
        session: the transaction of the claim.
        job: locked.
        attempt: of the shard, from 1.
        now: by the database's clock.
    """
    job.attempt = max(job.attempt, attempt)
    for row in (_parent(session, job), job):
        if row is None:
            continue
        pace.begin(session, row, now)
        row.heartbeat_at = now
        if row.state == "queued":
            row.started_at = now
            _set_state(session, row, "running")


def heard_from(session: Session, job: JobRow, now: datetime) -> None:
    """A worker is at the job, and so at its parent.

    Args:
        session: the transaction that it belongs to.
        job: locked.
        now: by the database's clock.
    """
    for row in (_parent(session, job), job):
        if row is not None:
            row.heartbeat_at = now


def shard_succeeded(
    session: Session, job: JobRow, shard: ShardRow, result: ShardResult, now: datetime
) -> None:
    """Apply a shard's result; when it was the stage's last, start the next stage or finish the job.

    Args:
        session: the transaction that commits the shard.
        job: locked.
        shard: of the job.
        result: of the shard's kind.
        now: by the database's clock.
    """
    heard_from(session, job, now)
    kind = SHARDS[shard.kind]
    if kind.is_helper:
        return
    job.stage_done += 1
    result.lineage.job_id = job.id
    if not result.lineage.inputs:
        result.lineage.inputs = [Reference.model_validate(item) for item in job.inputs]
    kind.apply(session, job, shard, result)
    if kind.progress is Tells.SHARDS_DONE:
        _report_shards_done(session, job, kind.span, now)
    if job.stage_done < job.stage_total:
        put_up_more(session, job, shard)
    elif kind.next is not None:
        _start_stage(session, job, shard, result, now)
    else:
        job.finished_at = now
        _set_state(session, job, "succeeded")
        _child_succeeded(session, job, now)


def report_progress(
    session: Session, job: JobRow, progress: Progress, span: tuple[float, float], now: datetime
) -> None:
    """Store and log the job's progress, and what it means for its parent.

    Args:
        session: the transaction that it belongs to.
        job: locked.
        progress: of the shard that tells, or of the shards that are done.
        span: the part of the job that such shards cover.
        now: by the database's clock.
    """
    _set_progress(session, job, of_the_job(progress, _progress(job), span), (), now)
    parent = _parent(session, job)
    if parent is not None and parent.state not in TERMINAL_STATES:
        own = _progress(job)
        message = f"{job.kind}: {own.done:g} of {own.total:g} {own.unit}"
        _report_children(session, parent, message, now)


def fail_job(session: Session, job: JobRow, problem: Problem, now: datetime) -> None:
    """Fail the job with its resource and its parent; its other shards are called off.

    Args:
        session: the transaction that it belongs to.
        job: locked.
        problem: why it failed.
        now: by the database's clock.
    """
    _stop_shards(session, job, (QUEUED, RUNNING), now)
    job.error = problem.model_dump(mode="json")
    kind_of(job).end(session, job, "failed", problem.detail or problem.title)
    job.finished_at = now
    _set_state(session, job, "failed")
    parent = _parent(session, job)
    if parent is not None and parent.state not in TERMINAL_STATES:
        raised = problem.model_copy(update={"detail": f"{job.kind} job {job.id}: {problem.detail}"})
        parent.error = raised.model_dump(mode="json")
        parent.finished_at = now
        _set_state(session, parent, "failed")


def request_cancel(session: Session, job: JobRow, now: datetime) -> None:
    """Cancel the job, its children and its parent. Running shards see it at their next ``renew``.

    Whatever their workers do, their leases end after ``CANCEL_WITHIN_S`` and are not prolonged: the job is then
    cancelled without them.

    Raises Conflict when the job has succeeded or failed; a second cancel changes nothing.
    """
    if job.state in {"succeeded", "failed"}:
        raise Conflict(f"job {job.id} has {job.state}; it can no longer be cancelled")
    root = _parent(session, job) or job
    for row in (root, *_children(session, root)):
        if row.state in TERMINAL_STATES or row.state == "cancelling":
            continue
        _stop_shards(session, row, (QUEUED,), now)
        _shorten_leases(session, row)
        _set_state(session, row, "cancelling")
    for row in (*_children(session, root), root):
        settle_cancel(session, row, now)


def settle_cancel(session: Session, job: JobRow, now: datetime) -> None:
    """A cancelling job with nothing running any more is cancelled; then its parent is asked the same."""
    if job.state != "cancelling":
        return
    _stop_shards(session, job, (QUEUED,), now)
    if _has_running(session, job):
        return
    if any(child.state not in TERMINAL_STATES for child in _children(session, job)):
        return
    kind_of(job).end(session, job, "cancelled", "")
    job.finished_at = now
    _set_state(session, job, "cancelled")
    parent = _parent(session, job)
    if parent is not None:
        settle_cancel(session, parent, now)


def _start_stage(session: Session, job: JobRow, shard: ShardRow, result: ShardResult, now: datetime) -> None:
    """Put up what follows the stage that ended with this shard."""
    follows = SHARDS[shard.kind].next
    assert follows is not None
    stage = follows(shard, result)
    job.stage += 1
    put_up(session, job, stage)
    if SHARDS[stage.shard].progress is Tells.SHARDS_DONE:
        _report_shards_done(session, job, SHARDS[stage.shard].span, now)
    parent = _parent(session, job)
    if parent is not None:
        kind_of(parent).stage_opened(session, parent, job)


def _report_shards_done(session: Session, job: JobRow, span: tuple[float, float], now: datetime) -> None:
    done = Progress(done=job.stage_done, total=job.stage_total, unit=kind_of(job).unit)
    report_progress(session, job, done, span, now)


def _child_succeeded(session: Session, child: JobRow, now: datetime) -> None:
    """Open the parent's next child, or finish the parent."""
    parent = _parent(session, child)
    if parent is None or parent.state in TERMINAL_STATES:  # what ran beside this child has failed
        return
    parent.outputs = [*parent.outputs, *child.outputs]
    message = f"{child.kind} done"
    append_event(session, parent.id, "log", {"message": message, "child": child.id, "kind": child.kind})
    _report_children(session, parent, message, now)
    if not kind_of(parent).open_next(session, parent, child, _children(session, parent)):
        parent.finished_at = now
        _set_state(session, parent, "succeeded")


def _report_children(session: Session, parent: JobRow, message: str, now: datetime) -> None:
    """Store and log what the children's progress comes to."""
    children, before = _children(session, parent), _progress(parent)
    share = max(before.fraction or 0.0, pace.share_done(parent, children))
    told = Progress(done=round(100 * share, 2), total=100, unit="percent", message=message)
    _set_progress(session, parent, of_the_job(told, before, (0.0, 1.0)), children, now)


def _progress(job: JobRow) -> Progress:
    return Progress.model_validate(job.progress)


def _set_progress(
    session: Session, job: JobRow, progress: Progress, children: Sequence[JobRow], now: datetime
) -> None:
    job.progress = progress.model_dump()
    pace.mark(job, now)
    job.progress = {**job.progress, "eta_s": pace.left_s(job, children, now)}
    append_event(session, job.id, "progress", job.progress)


def _set_state(session: Session, job: JobRow, state: str) -> None:
    job.state = state
    if state == "succeeded":
        assert job.finished_at is not None
        pace.end(job, job.finished_at)
    if state in TERMINAL_STATES:
        whole = {"fraction": 1.0} if state == "succeeded" else {}
        job.progress = {**job.progress, **whole, "eta_s": None}
    data: dict[str, Any] = {"state": state}
    if job.error is not None:
        data["error"] = job.error
    append_event(session, job.id, "state", data)
    session.flush()


def _stop_shards(session: Session, job: JobRow, states: tuple[str, ...], now: datetime) -> None:
    session.execute(
        update(ShardRow)
        .where(ShardRow.job_id == job.id, ShardRow.state.in_(states))
        .values(state=CANCELLED, lease_owner=None, lease_until=None, finished_at=now)
    )


def _shorten_leases(session: Session, job: JobRow) -> None:
    end = database_now(session) + timedelta(seconds=CANCEL_WITHIN_S)
    held = (ShardRow.job_id == job.id, ShardRow.state == RUNNING, ShardRow.lease_until > end)
    session.execute(update(ShardRow).where(*held).values(lease_until=end))


def _has_running(session: Session, job: JobRow) -> bool:
    running = exists().where(ShardRow.job_id == job.id, ShardRow.state == RUNNING)
    return bool(session.scalar(select(running)))


def _parent(session: Session, job: JobRow) -> JobRow | None:
    """The parent, which ``physworld_storage.jobs.shards.lock_job`` has locked and loaded."""
    return None if job.parent_id is None else session.get_one(JobRow, job.parent_id)


def _children(session: Session, job: JobRow) -> list[JobRow]:
    if not kind_of(job).has_children:
        return []
    order = (JobRow.created_at, JobRow.id)
    statement = select(JobRow).where(JobRow.parent_id == job.id).order_by(*order)
    return list(session.scalars(statement.execution_options(populate_existing=True)))
