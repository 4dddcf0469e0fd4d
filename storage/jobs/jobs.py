"""Jobs: opened, looked at, cancelled, taken up again. Every function is part of the caller's one transaction.

States: queued -> running -> succeeded | failed, and queued | running -> cancelling -> cancelled. A retry takes a
failed job to queued again: what is stored stays (finished shards, stored episodes, journals and checkpoints in the
scratch, ``physworld_workers.housekeeping``), what failed is queued with fresh counters. A pipeline and its children are
one piece of work: to retry one of them retries every child that failed, and the pipeline goes on after them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from physworld_schemas.assessment import AssessmentCreate
from physworld_schemas.base import Artifact, Page
from physworld_schemas.check import CheckCreate
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_schemas.loop import LoopCreate
from physworld_schemas.model import TrainingCreate
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceCreate
from physworld_schemas.tracking import TrackingOptions
from physworld_schemas.video import VideoCreate
from physworld_storage.changes import announce
from physworld_storage.errors import Conflict
from physworld_storage.jobs.events import append_event
from physworld_storage.jobs.flow import request_cancel
from physworld_storage.jobs.helpers import SIMULATION
from physworld_storage.jobs.kinds import (
    assessment,
    check,
    dataset,
    fit,
    kind_of,
    loop,
    pipeline,
    plan,
    rollout,
    trace,
    tracking,
    training,
    video,
)
from physworld_storage.jobs.shards import CANCELLED, FAILED, QUEUED, lock_job
from physworld_storage.pages import page_of
from physworld_storage.rows import chosen, required
from physworld_storage.runs import RunKind
from physworld_storage.tables import JobRow, ShardRow, columns_of, utc_now

RUNS: dict[RunKind, rollout.RunJobs] = {"rollout": rollout.KIND, "plan": plan.KIND}


def create_tracking(session: Session, upload: Artifact, options: TrackingOptions) -> Job:
    """Open a tracking of stored pictures; the scene that it makes is in ``outputs`` once it is there."""
    return _job(session, tracking.KIND.open(session, upload, options))


def create_fit(
    session: Session,
    scene_id: str,
    config: FitConfig,
    parent: JobRow | None = None,
    scene_ids: Sequence[str] = (),
) -> Job:
    """Open a fit (its row is pending, its id is in ``outputs``). Raises NotFound, Conflict.

    Args: those of ``fit.KIND.open``.
    """
    return _job(session, fit.KIND.open(session, scene_id, config, parent, scene_ids))


def create_check(session: Session, request: CheckCreate) -> Job:
    """Open a check of a scene. Raises NotFound."""
    return _job(session, check.KIND.open(session, request))


def create_video(session: Session, request: VideoCreate) -> Job:
    """Open a film. Raises NotFound, or Conflict when what it shows is not ready."""
    return _job(session, video.KIND.open(session, request))


def create_trace(session: Session, request: TraceCreate) -> Job:
    """Open a trace. Raises NotFound, or Conflict when the fit is not ready or of another kind of object."""
    opened = trace.KIND.open(
        session,
        request.scene_id,
        request.fit,
        request.config,
        request.fit_id,
        scene_ids=request.scene_ids,
        held_out_scene_ids=request.held_out_scene_ids,
    )
    return _job(session, opened)


def create_dataset(session: Session, fit_id: str, config: DatasetConfig, trace_id: str | None = None) -> Job:
    """Open a dataset. Raises NotFound, or Conflict when the fit or the trace is not ready.

    Args: those of ``dataset.KIND.open``.
    """
    return _job(session, dataset.KIND.open(session, fit_id, config, trace_id))


def create_assessment(session: Session, name: str, version: int, request: AssessmentCreate) -> Job:
    """Open an assessment of a model version. Raises NotFound, or Conflict when it is not ready.

    Args: those of ``assessment.KIND.open``.
    """
    return _job(session, assessment.KIND.open(session, name, version, request))


def create_training(session: Session, request: TrainingCreate, parent: JobRow | None = None) -> Job:
    """Open a training and allot its version. Raises NotFound, or Conflict when the dataset is not sealed."""
    return _job(session, training.KIND.open(session, request, parent))


def create_pipeline(session: Session, request: PipelineCreate) -> Job:
    """Open fit, dataset and training as one job. Raises NotFound."""
    return _job(session, pipeline.KIND.open(session, request))


def create_loop(session: Session, request: LoopCreate) -> Job:
    """Open one turn of the loop. Raises NotFound, or Conflict when the version or the recording does not do."""
    return _job(session, loop.KIND.open(session, request))


def create_run(
    session: Session,
    kind: RunKind,
    name: str,
    version: int,
    config: dict[str, Any],
    request: Artifact,
    total: float,
) -> Job:
    """Open a rollout or a plan with a model version. Raises NotFound, or Conflict when it is not ready.

    Args:
        session: the transaction that it belongs to.
        kind: of the run.
        name: of the model.
        version: its number.
        config: the request without its arrays.
        request: the whole request, as a stored file.
        total: of its progress: a rollout's steps, a plan's iterations.
    """
    return _job(session, RUNS[kind].open(session, name, version, config, request, total))


def get_job(session: Session, job_id: str) -> Job:
    """The job, or NotFound."""
    return _job(session, required(session, JobRow, job_id))


def states_of(session: Session, job_ids: Sequence[str]) -> dict[str, str]:
    """States of these jobs; unknown ones are left out."""
    rows = session.execute(select(JobRow.id, JobRow.state).where(JobRow.id.in_(job_ids)))
    return {row.id: row.state for row in rows}


def list_jobs(
    session: Session,
    *,
    limit: int = 50,
    cursor: str | None = None,
    state: str | None = None,
    kind: str | None = None,
    parent_id: str | None = None,
) -> Page[Job]:
    """Jobs, newest first.

    Args:
        session: the transaction to read in.
        limit: at most so many on the page.
        cursor: of the page before.
        state: only jobs in this state.
        kind: only jobs of this kind.
        parent_id: only children of this job.
    """
    statement = select(JobRow)
    filters = ((JobRow.state, state), (JobRow.kind, kind), (JobRow.parent_id, parent_id))
    statement = chosen(statement, *filters)
    keys = (JobRow.created_at, JobRow.id)
    return page_of(session, statement, keys, lambda row: _job(session, row), limit=limit, cursor=cursor)


def cancel_job(session: Session, job_id: str) -> Job:
    """Cancel a job with its children and its parent; running work stops at its next heartbeat.

    Raises NotFound, or Conflict when the job has succeeded or failed. Cancelling twice is harmless.
    """
    job = lock_job(session, job_id)
    request_cancel(session, job, utc_now())
    return _job(session, job)


def retry_job(session: Session, job_id: str) -> Job:
    """Queue a failed job again, with its pipeline and what failed beside it.

    Raises NotFound, or Conflict when the job has not failed or its pipeline was cancelled.
    """
    job = lock_job(session, job_id)
    if job.state != "failed":
        raise Conflict(f"job {job_id} is {job.state}; only a failed job can be retried")
    root = job if job.parent_id is None else session.get_one(JobRow, job.parent_id)
    if root.state not in {"failed", "running"}:
        raise Conflict(f"job {job_id} belongs to pipeline {root.id}, which is {root.state}")
    has_children = kind_of(root).has_children
    failed = select(JobRow).where(JobRow.parent_id == root.id, JobRow.state == "failed")
    locked = failed.with_for_update(key_share=True).execution_options(populate_existing=True)
    for row in session.scalars(locked).all() if has_children else [root]:
        _reopen(session, row, "queued")
        _reopen_shards(session, row)
        kind_of(row).reopen(session, row)
    if has_children and root.state == "failed":
        _reopen(session, root, "running")
    session.flush()
    announce(session)
    return _job(session, job)


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


def _job(session: Session, row: JobRow) -> Job:
    session.flush()
    children: list[str] = []
    if kind_of(row).has_children:
        order = (JobRow.created_at, JobRow.id)
        children = list(session.scalars(select(JobRow.id).where(JobRow.parent_id == row.id).order_by(*order)))
    return Job.model_validate({**columns_of(row), "children": children})
