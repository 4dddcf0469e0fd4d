"""What a new rollout or plan consists of: a job, a pending run with the request among its files, one shard."""

from __future__ import annotations

from typing import Any

from sqlalchemy.orm import Session

from physworld_schemas.base import Artifact, Reference
from physworld_schemas.ids import new_id
from physworld_schemas.job import Progress
from physworld_storage.errors import Conflict
from physworld_storage.jobs.opening import add_shards, open_job, pending_lineage
from physworld_storage.registry import reference_id, version_row
from physworld_storage.runs import RunKind
from physworld_storage.tables import JobRow, ModelVersionRow, RunRow, utc_now


def ready_version(session: Session, name: str, version: int) -> ModelVersionRow:
    """The row of a ready version. Raises NotFound, or Conflict when it is not ready."""
    row = version_row(session, name, version)
    if row.state != "ready" or row.scene_id is None or row.fit_id is None:
        raise Conflict(f"version {version} of {name} is {row.state}; only a ready version predicts")
    return row


def open_run(
    session: Session,
    kind: RunKind,
    name: str,
    version: int,
    config: dict[str, Any],
    request: Artifact,
    progress: Progress,
) -> JobRow:
    """A rollout or plan with a ready version; ``request`` is the whole request, ``config`` it without its arrays.

    Raises NotFound, or Conflict when the version is not ready.
    """
    model = ready_version(session, name, version)
    run_id = new_id(kind)
    job = open_job(
        session,
        kind,
        parent=None,
        inputs=[Reference(kind="model", id=reference_id(name, version), digest=model.sha256)],
        outputs=[Reference(kind=kind, id=run_id)],
        config=config,
        progress=progress,
    )
    row = RunRow(
        id=run_id,
        kind=kind,
        model=name,
        version=version,
        state="pending",
        created_at=utc_now(),
        job_id=job.id,
        config=config,
        figures={},
        lineage=pending_lineage(job),
        artifacts=[request.model_dump(mode="json")],
    )
    session.add(row)
    payload = {
        "run_id": run_id,
        "model": name,
        "version": version,
        "request": request.sha256,
        "scene_id": model.scene_id,
        "fit_id": model.fit_id,
        "trace_id": model.trace_id,
    }
    add_shards(session, job, kind, payload)
    return job
