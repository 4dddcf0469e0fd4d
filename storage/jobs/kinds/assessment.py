"""Assessments: one shard compares a recording with a model version; a trace follows where it is worse than expected."""

from __future__ import annotations

from typing import Any

from pydantic import Field
from sqlalchemy.orm import Session

from physworld_schemas import queues
from physworld_schemas.assessment import AssessmentCreate, ComparedVersion, ErrorFigure, Outcome
from physworld_schemas.base import Reference
from physworld_schemas.fit import FitConfig
from physworld_schemas.ids import new_id
from physworld_schemas.trace import TRACE_PARTICLES
from physworld_storage import traces
from physworld_storage.errors import Conflict
from physworld_storage.jobs.events import append_event
from physworld_storage.jobs.kind import JobKind, ShardKind, ShardResult, output_of
from physworld_storage.jobs.kinds import trace
from physworld_storage.registry import reference_id, version_row
from physworld_storage.rows import required
from physworld_storage.tables import AssessmentRow, JobRow, ModelVersionRow, SceneRow, ShardRow


class AssessmentResult(ShardResult):
    """Of an ``assessment`` shard."""

    outcome: Outcome
    reason: str
    measured: ErrorFigure
    expected: ErrorFigure
    excess_m: float
    excess_ci95_m: tuple[float, float]
    baselines_m: dict[str, float | None] = Field(default_factory=dict)
    twin_m: float | None = None
    start_mismatch_m: float
    compared: ComparedVersion | None = None


def _apply(session: Session, job: JobRow, shard: ShardRow, result: AssessmentResult) -> None:
    """Keep the figures; a recording that the model predicts worse than expected is traced, if that was asked for."""
    figures = result.model_dump(mode="json", exclude={"lineage"})
    row = traces.mark_assessment_ready(session, shard.payload["assessment_id"], figures, result.lineage)
    request = AssessmentCreate.model_validate(job.config)
    if result.outcome != "worse_than_expected" or not request.open_trace:
        return
    declared = FitConfig(damping="none", particle_budget=TRACE_PARTICLES)
    opened = trace.KIND.open(session, row.scene_id, declared, request.trace)
    row.trace_id = output_of(opened)
    job.outputs = [*job.outputs, *opened.outputs]
    append_event(session, job.id, "log", {"message": "trace queued", "child": opened.id, "kind": "trace"})


class AssessmentJobs(JobKind):
    """Jobs that assess."""

    name = "assessment"
    unit = "rollouts"
    table = AssessmentRow
    shards = (
        ShardKind(
            "assessment",
            queues.TRAINING,
            "physworld_services.trainer.assessment:run",
            AssessmentResult,
            _apply,
        ),
    )

    def open(
        self,
        session: Session,
        name: str,
        version: int,
        request: AssessmentCreate,
        parent: JobRow | None = None,
    ) -> JobRow:
        """A recording held against a model version. Raises NotFound, or Conflict when a version is not ready.

        Args:
            session: the transaction that it belongs to.
            name: of the model.
            version: its number.
            request: the recording, and whether a trace may follow.
            parent: the loop that it belongs to.
        """
        model = assessable(session, name, version)
        other = request.compared_with
        compared = None if other is None else assessable(session, name, other)
        scene = required(session, SceneRow, request.scene_id)
        assessment_id = new_id("assessment")
        job = self.queued(
            session,
            total=1,
            inputs=[
                Reference(kind="model", id=reference_id(name, version), digest=model.sha256),
                Reference(kind="scene", id=scene.id, digest=scene.digest),
            ],
            output_id=assessment_id,
            config=request.model_dump(mode="json"),
            parent=parent,
        )
        row = AssessmentRow(
            id=assessment_id, name=name, version=version, scene_id=scene.id, config=job.config, figures={}
        )
        payload = {
            "assessment_id": assessment_id,
            "name": name,
            "scene_id": scene.id,
            "frames": request.frames,
            **_origin(model),
            "compared": None if compared is None else _origin(compared),
        }
        return self.begin(session, job, row, payload)

    def seconds(self, config: dict[str, Any]) -> float:
        """Of one recording."""
        return 5.0


KIND = AssessmentJobs()


def assessable(session: Session, name: str, version: int) -> ModelVersionRow:
    """The row of a ready version that knows its twin. Raises NotFound, or Conflict when it is not ready."""
    model = version_row(session, name, version)
    if model.state != "ready" or model.fit_id is None or model.scene_id is None:
        raise Conflict(f"version {version} of {name} is {model.state}; an assessment needs a ready version")
    return model


def _origin(model: ModelVersionRow) -> dict[str, Any]:
    """What a worker needs to put a version's twin on a recording."""
    return {
        "version": model.version,
        "model_scene_id": model.scene_id,
        "fit_id": model.fit_id,
        "trace_id": model.trace_id,
    }
