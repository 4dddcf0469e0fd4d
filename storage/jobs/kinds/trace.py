"""Traces: one shard attributes a scene's residual to effects; other workers help with its simulations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from physworld_schemas import queues
from physworld_schemas.base import Artifact, Reference
from physworld_schemas.fit import FitConfig
from physworld_schemas.ids import new_id
from physworld_schemas.trace import TraceConfig, Verdict
from physworld_storage import traces
from physworld_storage.errors import Conflict
from physworld_storage.jobs import helpers
from physworld_storage.jobs.kind import JobKind, ShardKind, ShardResult
from physworld_storage.jobs.kinds.fit import ready_fit
from physworld_storage.rows import required
from physworld_storage.tables import JobRow, SceneRow, ShardRow, TraceRow


class TraceResult(ShardResult):
    """Of a ``trace`` shard: the whole report, and the files."""

    verdict: Verdict
    report: dict[str, Any]
    artifacts: list[Artifact]


def _apply(session: Session, job: JobRow, shard: ShardRow, result: TraceResult) -> None:
    helpers.call_off(session, job.id)
    trace_id = shard.payload["trace_id"]
    traces.mark_trace_ready(
        session, trace_id, result.verdict, result.report, result.artifacts, result.lineage
    )
    KIND.fulfil(job, trace_id, traces.trace_digest(required(session, TraceRow, trace_id)))


class TraceJobs(JobKind):
    """Jobs that trace."""

    name = "trace"
    unit = "percent"
    table = TraceRow
    shards = (
        ShardKind(
            "trace",
            queues.SIMULATION,
            "physworld_workers.tasks.trace:run",
            TraceResult,
            _apply,
            keeps_scratch=True,
        ),
        helpers.KIND,
    )

    def open(
        self,
        session: Session,
        scene_id: str,
        fit: FitConfig,
        config: TraceConfig,
        fit_id: str | None = None,
        parent: JobRow | None = None,
        scene_ids: Sequence[str] = (),
        held_out_scene_ids: Sequence[str] = (),
    ) -> JobRow:
        """A trace of a scene, from a ready fit of its object. Raises NotFound, or Conflict when the fit does not do.

        Args:
            session: the transaction that it belongs to.
            scene_id: of the scene that is traced.
            fit: settings of the calibration.
            config: settings of the trace.
            fit_id: of a ready fit of the scene, or of another recording of its object.
            parent: the pipeline that it belongs to.
            scene_ids: scenes that are fitted with the first.
            held_out_scene_ids: scenes that are only reported on.
        """
        inputs = [
            Reference(kind="scene", id=known, digest=required(session, SceneRow, known).digest)
            for known in (scene_id, *scene_ids, *held_out_scene_ids)
        ]
        if fit_id is not None:
            inputs.append(_fit_of(session, fit_id, scene_id))
        trace_id = new_id("trace")
        settings = {"fit": fit.model_dump(mode="json"), "trace": config.model_dump(mode="json")}
        others = {"scene_ids": list(scene_ids), "held_out_scene_ids": list(held_out_scene_ids)}
        job = self.queued(
            session, total=100, inputs=inputs, output_id=trace_id, config=settings, parent=parent
        )
        row = TraceRow(
            id=trace_id,
            scene_id=scene_id,
            fit_id=fit_id,
            config=settings["trace"],
            fit=settings["fit"],
            report=others,
            artifacts=[],
        )
        payload = {"trace_id": trace_id, "scene_id": scene_id, "fit_id": fit_id, **others, **settings}
        return self.begin(session, job, row, payload)

    def seconds(self, config: dict[str, Any]) -> float:
        """By its particles and refits."""
        asked = config["trace"]
        return 0.005 * float(config["fit"]["particle_budget"] * asked["confirmed"] * asked["iterations"])


KIND = TraceJobs()


def _fit_of(session: Session, fit_id: str, scene_id: str) -> Reference:
    fit = ready_fit(session, fit_id, "a trace")
    home, scene = required(session, SceneRow, fit.scene_id), required(session, SceneRow, scene_id)
    if home.kind != scene.kind:
        raise Conflict(f"fit {fit_id} is of a {home.kind}, scene {scene_id} shows a {scene.kind}")
    if (fit.metrics.get("local") or {}).get("kept"):
        raise Conflict(
            f"fit {fit_id} carries a field over its body, which a trace would have to search with its effects; "
            "leave fit_id out, and the trace calibrates a homogeneous twin of its own"
        )
    return Reference(kind="fit", id=fit_id, digest=traces.fit_digest(fit))
