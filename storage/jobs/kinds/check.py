"""Checks: one shard says what a scene's motion can show; other workers help with its simulations."""

from __future__ import annotations

from sqlalchemy.orm import Session

from physworld_schemas import queues
from physworld_schemas.base import Reference
from physworld_schemas.check import CheckCreate, CheckReport
from physworld_schemas.ids import new_id
from physworld_storage import checks
from physworld_storage.jobs import helpers
from physworld_storage.jobs.kind import JobKind, ShardKind, ShardResult
from physworld_storage.rows import required
from physworld_storage.tables import CheckRow, JobRow, SceneRow, ShardRow


class CheckResult(ShardResult):
    """Of a ``check`` shard."""

    report: CheckReport


def _apply(session: Session, job: JobRow, shard: ShardRow, result: CheckResult) -> None:
    helpers.call_off(session, job.id)
    checks.mark_check_ready(session, shard.payload["check_id"], result.report, result.lineage)


class CheckJobs(JobKind):
    """Jobs that check."""

    name = "check"
    unit = "simulations"
    table = CheckRow
    shards = (
        ShardKind(
            "check",
            queues.SIMULATION,
            "physworld_workers.tasks.check:run",
            CheckResult,
            _apply,
            keeps_scratch=True,
        ),
        helpers.KIND,
    )

    def open(self, session: Session, request: CheckCreate) -> JobRow:
        """A check of a scene. Raises NotFound."""
        scene = required(session, SceneRow, request.scene_id)
        check_id = new_id("check")
        config = request.config.model_dump(mode="json")
        inputs = [Reference(kind="scene", id=scene.id, digest=scene.digest)]
        job = self.queued(session, total=0, inputs=inputs, output_id=check_id, config=config)
        row = CheckRow(id=check_id, scene_id=scene.id, config=config)
        return self.begin(session, job, row, {"check_id": check_id, "scene_id": scene.id, "config": config})


KIND = CheckJobs()
