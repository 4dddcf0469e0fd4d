"""Trackings: one shard follows an object in uploaded pictures and makes a scene.

The upload is an artifact that the shard names: a worker that takes the shard over finds it, and so does a retry. Once
the scene is there, the job is called off, or it failed long ago, the shard names it no longer, and it goes as every
file that nobody names (``physworld_storage.orphans``).
"""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import Field
from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas import queues
from physworld_schemas.base import Artifact, Reference, Unmade
from physworld_schemas.tracking import TrackingOptions
from physworld_storage import resources, videos
from physworld_storage.jobs.kind import JobKind, ShardKind, ShardResult
from physworld_storage.tables import JobRow, ShardRow

UPLOAD = "upload"


class TrackingResult(ShardResult):
    """Of a ``tracking`` shard: what ``resources.create_scene`` takes, the scene's archive first among its files."""

    facts: dict[str, Any]
    artifacts: list[Artifact] = Field(min_length=1)


class TrackingJobs(JobKind):
    """Jobs that make a scene of pictures."""

    name = "tracking"
    unit = "frames"
    makes = "scene"

    def __init__(self) -> None:
        handler = "physworld_workers.tasks.tracking:run"
        self.shards = (ShardKind("tracking", queues.INFERENCE, handler, TrackingResult, self._apply),)

    def open(self, session: Session, upload: Artifact, options: TrackingOptions) -> JobRow:
        """A tracking of an upload, whose name is the file's.

        Args:
            session: the transaction that it belongs to.
            upload: a stored archive of pictures, or a film.
            options: what a person says of them.
        """
        config = options.model_dump(mode="json", exclude_unset=True)
        inputs = [Reference(kind="artifact", id=upload.name, digest=upload.sha256)]
        asked = {"file": upload.name, **config}
        job = self.queued(session, total=0, inputs=inputs, output_id=None, config=asked)
        payload = {UPLOAD: upload.sha256, "file": upload.name, "options": config}
        return self.begin(session, job, None, payload)

    def end(self, session: Session, job: JobRow, state: Unmade, message: str) -> None:
        """There will be no scene; a failed job keeps its upload, for a retry."""
        if state == "cancelled":
            for shard in session.scalars(select(ShardRow).where(ShardRow.job_id == job.id)):
                _let_go(shard)

    def reopen(self, session: Session, job: JobRow) -> None:
        """Nothing is stored that could be pending again."""

    def subject(self, job: Any) -> str | None:
        """The file."""
        return str(job.config["file"])

    def _apply(self, session: Session, job: JobRow, shard: ShardRow, result: TrackingResult) -> None:
        archive, *pictures = result.artifacts
        known = resources.find_scene(session, archive.sha256)
        scene = known or resources.create_scene(
            session, digest=archive.sha256, artifacts=[archive], **result.facts
        )
        for picture in pictures:
            videos.put_picture(session, scene.id, picture)
        self.fulfil(job, scene.id, archive.sha256)
        _let_go(shard)


KIND = TrackingJobs()


def forget_uploads(session: Session, before: datetime) -> int:
    """Let go of the uploads of jobs that failed before a time; how many."""
    failed = (JobRow.kind == KIND.name, JobRow.state == "failed", JobRow.finished_at < before)
    shards = session.scalars(select(ShardRow).join(JobRow, JobRow.id == ShardRow.job_id).where(*failed))
    held = [shard for shard in shards if UPLOAD in shard.payload]
    for shard in held:
        _let_go(shard)
    return len(held)


def _let_go(shard: ShardRow) -> None:
    shard.payload = {name: value for name, value in shard.payload.items() if name != UPLOAD}
