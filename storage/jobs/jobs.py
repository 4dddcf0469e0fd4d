"""Jobs: opened, looked at, cancelled. Every function is part of the caller's one transaction.

States: queued -> running -> succeeded | failed, and queued | running -> cancelling -> cancelled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.assessment import AssessmentCreate
from physworld_schemas.base import Artifact, Page
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job, Progress
from physworld_schemas.model import TrainingCreate
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceCreate
from physworld_storage.errors import NotFound
from physworld_storage.jobs.events import append_event, events_after
from physworld_storage.jobs.flow import request_cancel
from physworld_storage.jobs.locks import lock_job
from physworld_storage.jobs.opening import (
    open_assessment,
    open_dataset,
    open_fit,
    open_pipeline,
    open_trace,
    open_training,
)
from physworld_storage.jobs.opening_runs import open_run
from physworld_storage.jobs.retries import retry_job as reopen
from physworld_storage.pages import page_of
from physworld_storage.runs import RunKind
from physworld_storage.tables import JobRow, columns_of, utc_now

__all__ = [
    "append_event",
    "cancel_job",
    "create_assessment",
    "create_dataset",
    "create_fit",
    "create_pipeline",
    "create_run",
    "create_trace",
    "create_training",
    "events_after",
    "get_job",
    "list_jobs",
    "retry_job",
    "states_of",
]


def create_fit(session: Session, scene_id: str, config: FitConfig, parent: JobRow | None = None) -> Job:
    """Open a fit (its row is pending, its id is in ``outputs``). Raises NotFound."""
    return _job(session, open_fit(session, scene_id, config, parent))


def create_trace(session: Session, request: TraceCreate) -> Job:
    """Open a trace. Raises NotFound, or Conflict when the fit is not ready or of another scene."""
    opened = open_trace(
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
    """Open a dataset. Raises NotFound, or Conflict when the fit or the trace is not ready."""
    return _job(session, open_dataset(session, fit_id, config, trace_id))


def create_assessment(session: Session, name: str, version: int, request: AssessmentCreate) -> Job:
    """Open an assessment of a model version. Raises NotFound, or Conflict when it is not ready."""
    return _job(session, open_assessment(session, name, version, request))


def create_training(session: Session, request: TrainingCreate, parent: JobRow | None = None) -> Job:
    """Open a training and allot its version. Raises NotFound, or Conflict when the dataset is not sealed."""
    return _job(session, open_training(session, request, parent))


def create_pipeline(session: Session, request: PipelineCreate) -> Job:
    """Open fit, dataset and training as one job. Raises NotFound."""
    return _job(session, open_pipeline(session, request))


def create_run(
    session: Session,
    kind: RunKind,
    name: str,
    version: int,
    config: dict[str, Any],
    request: Artifact,
    progress: Progress,
) -> Job:
    """Open a rollout or a plan with a model version. Raises NotFound, or Conflict when it is not ready."""
    return _job(session, open_run(session, kind, name, version, config, request, progress))


def get_job(session: Session, job_id: str) -> Job:
    """The job, or NotFound."""
    row = session.get(JobRow, job_id)
    if row is None:
        raise NotFound("job", job_id)
    return _job(session, row)


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
    """Jobs, newest first."""
    statement = select(JobRow)
    for column, wanted in ((JobRow.state, state), (JobRow.kind, kind), (JobRow.parent_id, parent_id)):
        if wanted is not None:
            statement = statement.where(column == wanted)
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
    """Take a failed job up again with its pipeline; what is stored stays.

    Raises NotFound, or Conflict when the job has not failed or its pipeline was cancelled.
    """
    return _job(session, reopen(session, job_id))


def _job(session: Session, row: JobRow) -> Job:
    session.flush()
    children: list[str] = []
    if row.kind == "pipeline":
        order = (JobRow.created_at, JobRow.id)
        children = list(session.scalars(select(JobRow.id).where(JobRow.parent_id == row.id).order_by(*order)))
    return Job.model_validate({**columns_of(row), "children": children})
