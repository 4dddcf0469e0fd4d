"""A failed job is taken up again: what is stored stays, what failed is queued with fresh counters.

Finished shards (stored episodes among them), journals and checkpoints in the scratch are kept for a failed job
(``physworld_workers.housekeeping``), so that a retry goes on where the job ended. A pipeline and its children are one
piece of
work: to retry one of them retries every child that failed, and the pipeline goes on after them.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from physworld_storage import registry
from physworld_storage.changes import announce
from physworld_storage.errors import Conflict
from physworld_storage.jobs.events import append_event
from physworld_storage.jobs.helpers import SIMULATION
from physworld_storage.jobs.locks import lock_job
from physworld_storage.jobs.opening import CANCELLED, FAILED, QUEUED
from physworld_storage.runs import RunKind, run_row
from physworld_storage.tables import AssessmentRow, DatasetRow, FitRow, JobRow, ShardRow, TraceRow

_TABLES: dict[str, type[FitRow | TraceRow | AssessmentRow]] = {
    "fit": FitRow,
    "trace": TraceRow,
    "assessment": AssessmentRow,
}


def retry_job(session: Session, job_id: str) -> JobRow:
    """Queue a failed job again, with its pipeline and what failed beside it.

    Raises NotFound, or Conflict when the job has not failed or its pipeline was cancelled.
    """
    job = lock_job(session, job_id)
    if job.state != "failed":
        raise Conflict(f"job {job_id} is {job.state}; only a failed job can be retried")
    root = job if job.parent_id is None else session.get_one(JobRow, job.parent_id)
    if root.state not in {"failed", "running"}:
        raise Conflict(f"job {job_id} belongs to pipeline {root.id}, which is {root.state}")
    failed = select(JobRow).where(JobRow.parent_id == root.id, JobRow.state == "failed")
    locked = failed.with_for_update(key_share=True).execution_options(populate_existing=True)
    for row in session.scalars(locked).all() if root.kind == "pipeline" else [root]:
        _reopen(session, row, "queued")
        _reopen_shards(session, row)
        _reopen_output(session, row)
    if root.kind == "pipeline" and root.state == "failed":
        _reopen(session, root, "running")
    session.flush()
    announce(session)
    return job


def _reopen(session: Session, job: JobRow, state: str) -> None:
    job.state, job.error, job.finished_at = state, None, None
    append_event(session, job.id, "log", {"message": "retried: what is stored stays"})
    append_event(session, job.id, "state", {"state": state})


def _reopen_shards(session: Session, job: JobRow) -> None:
    """Queue what failed or was called off in the present stage; the driver puts its helpers up anew."""
    ended = (ShardRow.job_id == job.id, ShardRow.stage == job.stage, ShardRow.kind != SIMULATION)
    session.execute(
        update(ShardRow)
        .where(*ended, ShardRow.state.in_((FAILED, CANCELLED)))
        .values(
            state=QUEUED,
            failures=0,
            losses=[],
            error=None,
            finished_at=None,
            not_before=None,
            published_at=None,
            lease_owner=None,
            lease_until=None,
        )
    )


def _reopen_output(session: Session, job: JobRow) -> None:
    output = str(job.outputs[0]["id"])
    if job.kind == "dataset":
        session.get_one(DatasetRow, output).state = "writing" if job.stage > 0 else "pending"
    elif job.kind == "training":
        name, _, version = output.rpartition(":")
        version_row = registry.version_row(session, name, int(version))
        version_row.state, version_row.message = "pending", ""
    elif job.kind in {"rollout", "plan"}:
        kind: RunKind = "plan" if job.kind == "plan" else "rollout"
        run_row(session, kind, output).state = "pending"
    else:
        row: Any = session.get_one(_TABLES[job.kind], output)
        row.state = "pending"
