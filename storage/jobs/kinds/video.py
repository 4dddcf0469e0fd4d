"""Films: one shard draws what moves in a scene, a fit, a model's prediction or a rollout."""

from __future__ import annotations

from typing import Any

from pydantic import Field
from sqlalchemy.orm import Session

from physworld_schemas import queues
from physworld_schemas.base import Artifact, Reference
from physworld_schemas.ids import new_id
from physworld_schemas.video import VideoCreate, VideoReport
from physworld_storage import videos
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.jobs.kind import JobKind, ShardKind, ShardResult
from physworld_storage.registry import reference_id, resolve, version_row
from physworld_storage.rows import required
from physworld_storage.runs import RESULT, run_row
from physworld_storage.tables import FitRow, JobRow, SceneRow, ShardRow, VideoRow

PREDICTION = "prediction.npz"


class VideoResult(ShardResult):
    """Of a ``video`` shard."""

    report: VideoReport
    artifacts: list[Artifact] = Field(min_length=1)


class VideoJobs(JobKind):
    """Jobs that draw."""

    name = "video"
    unit = "frames"
    table = VideoRow

    def __init__(self) -> None:
        handler = "physworld_workers.tasks.video:run"
        self.shards = (ShardKind("video", queues.INFERENCE, handler, VideoResult, self._apply),)

    def open(self, session: Session, request: VideoCreate) -> JobRow:
        """A film. Raises NotFound, or Conflict when what it shows is not ready."""
        shown, scene, motion = _shown(session, request)
        video_id = new_id("video")
        config = request.config.model_dump(mode="json")
        inputs = [shown]
        if shown.kind != "scene":
            inputs.append(Reference(kind="scene", id=scene.id, digest=scene.digest))
        # What the page of a job offers to do again is its configuration: it says what was drawn, too.
        asked = {"of": request.of, "id": shown.id, "config": config}
        job = self.queued(session, total=scene.frames, inputs=inputs, output_id=video_id, config=asked)
        row = VideoRow(
            id=video_id, of=request.of, source_id=shown.id, scene_id=scene.id, config=config, artifacts=[]
        )
        payload: dict[str, Any] = {
            "video_id": video_id,
            "of": request.of,
            "source": shown.model_dump(mode="json"),
        }
        payload |= {"scene_id": scene.id, "motion": motion, "config": config}
        return self.begin(session, job, row, payload)

    def _apply(self, session: Session, job: JobRow, shard: ShardRow, result: VideoResult) -> None:
        video_id = shard.payload["video_id"]
        videos.mark_video_ready(session, video_id, result.report, result.artifacts, result.lineage)
        self.fulfil(job, video_id, result.artifacts[0].sha256)


KIND = VideoJobs()


def _shown(session: Session, request: VideoCreate) -> tuple[Reference, SceneRow, str | None]:
    """What is drawn, its scene, and the digest of the arrays that move; None: the recording itself."""
    if request.of == "scene":
        scene = required(session, SceneRow, request.id)
        return Reference(kind="scene", id=scene.id, digest=scene.digest), scene, None
    if request.of == "fit":
        fit = required(session, FitRow, request.id)
        motion = _file(fit, f"fit {fit.id}", PREDICTION)
        return (
            Reference(kind="fit", id=fit.id, digest=motion),
            required(session, SceneRow, fit.scene_id),
            motion,
        )
    if request.of == "rollout":
        run = run_row(session, "rollout", request.id)
        motion = _file(run, f"rollout {run.id}", RESULT["rollout"])
        scene = required(session, SceneRow, str(version_row(session, run.model, run.version).scene_id))
        return Reference(kind="rollout", id=run.id, digest=motion), scene, motion
    name, _, number = request.id.partition(":")
    version = version_row(session, name, resolve(session, name, number or "latest"))
    motion = _file(version, f"version {version.version} of {name}", PREDICTION)
    known = reference_id(name, version.version)
    scene = required(session, SceneRow, str(version.scene_id))
    return Reference(kind="model", id=known, digest=version.sha256), scene, motion


def _file(row: Any, what: str, name: str) -> str:
    """The digest of a file of a ready object. Raises Conflict, NotFound."""
    if row.state != "ready":
        raise Conflict(f"{what} is {row.state}; a film shows what is ready")
    for artifact in row.artifacts:
        if artifact["name"] == name:
            return str(artifact["sha256"])
    raise NotFound("artifact", f"{name} of {what}")
