"""Datasets: one shard plans, then one shard for each episode, then one that seals."""

from __future__ import annotations

from typing import Any

from pydantic import Field
from sqlalchemy.orm import Session

from physworld_schemas import queues
from physworld_schemas.base import Artifact, Reference, Unmade
from physworld_schemas.dataset import DatasetConfig, Episode
from physworld_schemas.ids import new_id
from physworld_storage import resources
from physworld_storage.errors import Conflict
from physworld_storage.jobs.kind import JobKind, ShardKind, ShardResult, Tells, output_of
from physworld_storage.jobs.kinds.fit import ready_fit
from physworld_storage.jobs.shards import Stage
from physworld_storage.rows import required
from physworld_storage.tables import DatasetRow, JobRow, ShardRow, TraceRow
from physworld_storage.traces import fit_digest, trace_digest

MAX_EPISODES = 20_000
WRITING = 1
"""The stage in which a dataset's episodes are made."""


class PlanResult(ShardResult):
    """Of a ``dataset_plan`` shard: how many episodes follow, and their size."""

    episodes: int = Field(ge=1, le=MAX_EPISODES)
    frames: int = Field(ge=1)
    particles: int = Field(ge=1)


class EpisodeResult(ShardResult):
    """Of an ``episode`` shard: where the episode was written and what it holds."""

    index: int = Field(ge=0)
    path: str = Field(min_length=1)
    digest: str = Field(pattern=r"^[0-9a-f]{64}$")
    seed: int = Field(ge=-(2**63), lt=2**63)
    frames: int = Field(ge=1)
    particles: int = Field(ge=1)
    motion: str = ""
    seconds: float | None = None

    def fault_at(self, index: int) -> str | None:
        """An episode's index is that of its shard."""
        if self.index == index:
            return None
        return f"episode result carries index {self.index}, its shard is number {index}"


class SealResult(ShardResult):
    """Of a ``dataset_seal`` shard: ``digest`` is the manifest's."""

    digest: str = Field(pattern=r"^[0-9a-f]{64}$")
    statistics: dict[str, Any] = Field(default_factory=dict)
    artifacts: list[Artifact]


def _planned(session: Session, job: JobRow, shard: ShardRow, result: PlanResult) -> None:
    resources.start_writing(session, shard.payload["dataset_id"])


def _episodes(shard: ShardRow, result: PlanResult) -> Stage:
    plan = {"frames": result.frames, "particles": result.particles}
    return Stage("episode", {**shard.payload, "plan": plan}, result.episodes)


def _written(session: Session, job: JobRow, shard: ShardRow, result: EpisodeResult) -> None:
    episode = Episode(**result.model_dump(include=set(Episode.model_fields)), attempt=shard.attempt)
    resources.add_episode(session, shard.payload["dataset_id"], shard.id, episode, result.seconds)


def _seal(shard: ShardRow, result: EpisodeResult) -> Stage:
    left_out = {"index", "plan"}
    return Stage("dataset_seal", {key: item for key, item in shard.payload.items() if key not in left_out})


def _sealed(session: Session, job: JobRow, shard: ShardRow, result: SealResult) -> None:
    dataset_id = shard.payload["dataset_id"]
    resources.seal_dataset(
        session,
        dataset_id,
        digest=result.digest,
        statistics=result.statistics,
        artifacts=result.artifacts,
        lineage=result.lineage,
    )
    KIND.fulfil(job, dataset_id, result.digest)


class DatasetJobs(JobKind):
    """Jobs that write datasets."""

    name = "dataset"
    unit = "episodes"
    table = DatasetRow
    shards = (
        ShardKind(
            "dataset_plan",
            queues.SIMULATION,
            "physworld_workers.tasks.dataset:plan",
            PlanResult,
            _planned,
            _episodes,
            Tells.NOTHING,
            span=(0.0, 0.1),
        ),
        ShardKind(
            "episode",
            queues.SIMULATION,
            "physworld_workers.tasks.dataset:episode",
            EpisodeResult,
            _written,
            _seal,
            Tells.SHARDS_DONE,
            span=(0.1, 0.95),
        ),
        ShardKind(
            "dataset_seal",
            queues.SIMULATION,
            "physworld_workers.tasks.dataset:seal",
            SealResult,
            _sealed,
            span=(0.95, 1.0),
        ),
    )

    def open(
        self,
        session: Session,
        fit_id: str,
        config: DatasetConfig,
        trace_id: str | None = None,
        parent: JobRow | None = None,
    ) -> JobRow:
        """A dataset of demonstrations in a ready fit, or in the twin that a trace made of it.

        Raises NotFound, or Conflict when the fit or the trace is not ready or they are of different scenes.

        Args:
            session: the transaction that it belongs to.
            fit_id: of a ready fit.
            config: its settings.
            trace_id: of a ready trace of the same scene.
            parent: the pipeline that it belongs to.
        """
        fit = ready_fit(session, fit_id, "a dataset")
        inputs = [Reference(kind="fit", id=fit_id, digest=fit_digest(fit))]
        if trace_id is not None:
            trace = required(session, TraceRow, trace_id)
            if trace.state != "ready":
                raise Conflict(f"trace {trace_id} is {trace.state}; a dataset needs a ready trace")
            if trace.scene_id != fit.scene_id:
                raise Conflict(
                    f"trace {trace_id} is of scene {trace.scene_id}, fit {fit_id} of {fit.scene_id}: its twin stands "
                    "in another recording; a trace of both together (scene_id the fit's, scene_ids the other), or "
                    "a loop, leaves a twin in the fit's"
                )
            inputs.append(Reference(kind="trace", id=trace_id, digest=trace_digest(trace)))
        dataset_id = new_id("dataset")
        job = self.queued(
            session,
            total=config.episodes,
            inputs=inputs,
            output_id=dataset_id,
            config=config.model_dump(mode="json"),
            parent=parent,
        )
        origin = {"fit_id": fit_id, "trace_id": trace_id, "scene_id": fit.scene_id, "config": job.config}
        row = DatasetRow(id=dataset_id, **origin, statistics={}, artifacts=[])
        return self.begin(session, job, row, {"dataset_id": dataset_id, **origin})

    def seconds(self, config: dict[str, Any]) -> float:
        """By its episodes."""
        return 2.0 + 0.3 * float(config["episodes"])

    def end(self, session: Session, job: JobRow, state: Unmade, message: str) -> None:
        """The dataset has failed or was cancelled; its episodes stay."""
        resources.end_dataset(session, output_of(job), state)

    def reopen(self, session: Session, job: JobRow) -> None:
        """The dataset goes on with the episodes that it has."""
        row = session.get_one(DatasetRow, output_of(job))
        row.state = "writing" if job.stage >= WRITING else "pending"


KIND = DatasetJobs()
