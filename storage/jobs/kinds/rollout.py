"""Rollouts that are too large to be answered at once, and what plans share with them: one shard runs a version."""

from __future__ import annotations

from typing import Any

from pydantic import Field
from sqlalchemy.orm import Session

from physworld_schemas import queues
from physworld_schemas.base import Artifact, Reference
from physworld_schemas.ids import new_id
from physworld_storage import runs
from physworld_storage.errors import Conflict
from physworld_storage.jobs.kind import JobKind, ShardKind, ShardResult
from physworld_storage.registry import reference_id, version_row
from physworld_storage.tables import JobRow, ModelVersionRow, RunRow, ShardRow


class RunResult(ShardResult):
    """Of a ``rollout`` or ``plan`` shard: what it says beside its files."""

    figures: dict[str, Any]
    artifacts: list[Artifact] = Field(min_length=1)


class RunJobs(JobKind):
    """Jobs that ask a model version something; ``unit`` is what their progress counts."""

    table = RunRow

    def __init__(self, name: runs.RunKind, unit: str) -> None:
        self.name, self.unit = name, unit
        self._run: runs.RunKind = name
        handler = f"physworld_services.inference.jobs:{name}"
        self.shards = (ShardKind(name, queues.INFERENCE, handler, RunResult, self._apply),)

    def open(
        self,
        session: Session,
        name: str,
        version: int,
        config: dict[str, Any],
        request: Artifact,
        total: float,
    ) -> JobRow:
        """A rollout or plan with a ready version. Raises NotFound, or Conflict when the version is not ready.

        Args:
            session: the transaction that it belongs to.
            name: of the model.
            version: its number.
            config: the request without its arrays.
            request: the whole request, as a stored file.
            total: of its progress, in ``unit``.
        """
        model = ready_version(session, name, version)
        run_id = new_id(self._run)
        job = self.queued(
            session,
            total=total,
            inputs=[Reference(kind="model", id=reference_id(name, version), digest=model.sha256)],
            output_id=run_id,
            config=config,
        )
        row = RunRow(
            id=run_id,
            kind=self.name,
            model=name,
            version=version,
            config=config,
            figures={},
            artifacts=[request.model_dump(mode="json")],
        )
        payload = {
            "run_id": run_id,
            "model": name,
            "version": version,
            "request": request.sha256,
            "scene_id": model.scene_id,
            "fit_id": model.fit_id,
            "trace_id": model.trace_id,
        }
        return self.begin(session, job, row, payload)

    def _apply(self, session: Session, job: JobRow, shard: ShardRow, result: RunResult) -> None:
        run_id = shard.payload["run_id"]
        runs.mark_run_ready(session, self._run, run_id, result.figures, result.artifacts, result.lineage)
        self.fulfil(job, run_id, runs.run_digest(result.artifacts, self._run))


KIND = RunJobs("rollout", "steps")


def ready_version(session: Session, name: str, version: int) -> ModelVersionRow:
    """The row of a ready version. Raises NotFound, or Conflict when it is not ready."""
    row = version_row(session, name, version)
    if row.state != "ready" or row.scene_id is None or row.fit_id is None:
        raise Conflict(f"version {version} of {name} is {row.state}; only a ready version predicts")
    return row
