"""Shards, the units that workers execute: put up stage by stage, counted, under the lock of their job."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import func, insert, select
from sqlalchemy.orm import Session

from physworld_schemas.ids import new_id
from physworld_schemas.job import TERMINAL_STATES
from physworld_storage.changes import announce
from physworld_storage.database import DEFAULT_MAX_ATTEMPTS, MAX_ATTEMPTS
from physworld_storage.errors import NotFound
from physworld_storage.tables import JobRow, ShardRow, utc_now

QUEUED, RUNNING, DONE, FAILED, CANCELLED = "QUEUED", "RUNNING", "DONE", "FAILED", "CANCELLED"
STAGE_WINDOW = 1024
"""Shards of a stage that exist ahead of the work: enough for every worker, few enough for one short transaction."""


@dataclass(frozen=True)
class Stage:
    """What a job does next: one shard of kind ``shard``, or ``total`` of them that differ in ``payload["index"]``."""

    shard: str
    payload: dict[str, Any]
    total: int | None = None


def lock_job(session: Session, job_id: str) -> JobRow:
    """The job, locked until the transaction ends; its parent is locked first. Raises NotFound."""
    parent_id = session.scalar(select(JobRow.parent_id).where(JobRow.id == job_id))
    if parent_id is not None:
        _lock(session, parent_id)
    return _lock(session, job_id)


def put_up(session: Session, job: JobRow, stage: Stage) -> None:
    """Queue the shards of the job's present stage.

    Of many only the first ``STAGE_WINDOW`` are made now, so that no transaction grows with the stage;
    ``put_up_more`` makes the others as these are done.
    """
    job.stage_total, job.stage_done = 1 if stage.total is None else stage.total, 0
    payloads = [stage.payload]
    if stage.total is not None:
        payloads = [{**stage.payload, "index": index} for index in range(min(stage.total, STAGE_WINDOW))]
    _insert(session, job, stage.shard, 0, payloads, utc_now())


def put_up_more(session: Session, job: JobRow, like: ShardRow) -> None:
    """Make the next shards of the stage that ``like`` belongs to, where fewer than half a window are left.

    Called under the job's lock in the transaction that commits a shard, so none is left out and none made twice.
    """
    place = (ShardRow.job_id == job.id, ShardRow.stage == job.stage, ShardRow.kind == like.kind)
    made = 1 + (session.scalar(select(func.max(ShardRow.index)).where(*place)) or 0)
    if made >= job.stage_total or made - job.stage_done > STAGE_WINDOW // 2:
        return
    indices = range(made, min(job.stage_total, job.stage_done + STAGE_WINDOW))
    payloads = [{**like.payload, "index": index} for index in indices]
    _insert(session, job, like.kind, made, payloads, like.created_at)


def count_jobs(session: Session) -> dict[tuple[str, str], int]:
    """Jobs by (kind, state)."""
    rows = session.execute(
        select(JobRow.kind, JobRow.state, func.count()).group_by(JobRow.kind, JobRow.state)
    )
    return {(kind, state): count for kind, state, count in rows}


def count_shards(session: Session) -> dict[tuple[str, str], int]:
    """Shards by (kind, state); those of a long stage that will be made as it goes on count as queued."""
    rows = session.execute(
        select(ShardRow.kind, ShardRow.state, func.count()).group_by(ShardRow.kind, ShardRow.state)
    )
    counts = {(kind, state): count for kind, state, count in rows}
    made = (
        select(ShardRow.kind, JobRow.stage_total, func.max(ShardRow.index) + 1)
        .join(JobRow, (JobRow.id == ShardRow.job_id) & (JobRow.stage == ShardRow.stage))
        .where(JobRow.stage_total > STAGE_WINDOW, JobRow.state.not_in(TERMINAL_STATES))
        .group_by(JobRow.id, ShardRow.kind, JobRow.stage_total)
    )
    for kind, total, here in session.execute(made):
        if here < total:
            counts[kind, QUEUED] = counts.get((kind, QUEUED), 0) + total - here
    return counts


def _insert(
    session: Session, job: JobRow, kind: str, first: int, payloads: list[dict[str, Any]], at: datetime
) -> None:
    cap = session.info.get(MAX_ATTEMPTS, DEFAULT_MAX_ATTEMPTS)
    rows = [
        {
            "id": new_id("shard"),
            "job_id": job.id,
            "stage": job.stage,
            "index": first + number,
            "kind": kind,
            "state": QUEUED,
            "attempt": 0,
            "max_attempts": cap,
            "epoch": 0,
            "created_at": at,
            "payload": payload,
        }
        for number, payload in enumerate(payloads)
    ]
    session.flush()
    session.execute(insert(ShardRow), rows)
    announce(session)


def _lock(session: Session, job_id: str) -> JobRow:
    statement = select(JobRow).where(JobRow.id == job_id).with_for_update(key_share=True)
    row = session.scalars(statement.execution_options(populate_existing=True)).one_or_none()
    if row is None:
        raise NotFound("job", job_id)
    return row
