"""Fits: one shard calibrates a twin of a scene; other workers help with its simulations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from physworld_schemas import queues
from physworld_schemas.base import Artifact, Reference
from physworld_schemas.fit import FitConfig, Parameter
from physworld_schemas.ids import new_id
from physworld_storage import resources
from physworld_storage.errors import Conflict
from physworld_storage.jobs import helpers
from physworld_storage.jobs.kind import JobKind, ShardKind, ShardResult
from physworld_storage.rows import required
from physworld_storage.tables import FitRow, JobRow, SceneRow, ShardRow
from physworld_storage.traces import fit_digest


class FitResult(ShardResult):
    """Of a ``fit`` shard."""

    parameters: dict[str, Parameter]
    metrics: dict[str, Any]
    artifacts: list[Artifact]
    seconds: float | None = None


def _apply(session: Session, job: JobRow, shard: ShardRow, result: FitResult) -> None:
    helpers.call_off(session, job.id)
    fit_id = shard.payload["fit_id"]
    resources.mark_fit_ready(
        session, fit_id, result.parameters, result.metrics, result.artifacts, result.lineage
    )
    KIND.fulfil(job, fit_id, fit_digest(session.get_one(FitRow, fit_id)))


class FitJobs(JobKind):
    """Jobs that fit."""

    name = "fit"
    unit = "simulations"
    table = FitRow
    shards = (
        ShardKind(
            "fit", queues.SIMULATION, "physworld_workers.tasks.fit:run", FitResult, _apply, keeps_scratch=True
        ),
        helpers.KIND,
    )

    def open(
        self,
        session: Session,
        scene_id: str,
        config: FitConfig,
        parent: JobRow | None = None,
        scene_ids: Sequence[str] = (),
    ) -> JobRow:
        """A fit of a scene. Raises NotFound, or Conflict where another scene shows another kind of object.

        Args:
            session: the transaction that it belongs to.
            scene_id: of a stored scene.
            config: its settings.
            parent: the pipeline that it belongs to.
            scene_ids: further recordings of the object, fitted together with the first.
        """
        scenes = [required(session, SceneRow, known) for known in (scene_id, *scene_ids)]
        for scene in scenes[1:]:
            if scene.kind != scenes[0].kind:
                raise Conflict(
                    f"recordings of one object have one kind: scene {scene_id} shows a {scenes[0].kind}, "
                    f"{scene.id} a {scene.kind}"
                )
        fit_id = new_id("fit")
        job = self.queued(
            session,
            total=config.max_simulations,
            inputs=[Reference(kind="scene", id=scene.id, digest=scene.digest) for scene in scenes],
            output_id=fit_id,
            config=config.model_dump(mode="json"),
            parent=parent,
        )
        others = {"scene_ids": list(scene_ids)}
        row = FitRow(
            id=fit_id, scene_id=scene_id, config=job.config, parameters={}, metrics=others, artifacts=[]
        )
        payload = {"fit_id": fit_id, "scene_id": scene_id, **others, "config": job.config}
        return self.begin(session, job, row, payload)

    def seconds(self, config: dict[str, Any]) -> float:
        """By its particles; most searches end before their budget is spent."""
        return 3.0 + 0.0125 * float(config["particle_budget"])


KIND = FitJobs()


def ready_fit(session: Session, fit_id: str, for_what: str) -> FitRow:
    """The row of a ready fit. Raises NotFound, or Conflict when it is not ready."""
    fit = required(session, FitRow, fit_id)
    if fit.state != "ready":
        raise Conflict(f"fit {fit_id} is {fit.state}; {for_what} needs a ready fit")
    return fit
