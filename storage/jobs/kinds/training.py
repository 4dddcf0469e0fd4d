"""Trainings: one shard learns a world model from a dataset and publishes it as the next version of a model."""

from __future__ import annotations

from typing import Any

from pydantic import Field
from sqlalchemy.orm import Session

from physworld_schemas import queues
from physworld_schemas.base import Artifact, Reference, Unmade
from physworld_schemas.job import Job
from physworld_schemas.model import TrainingConfig, TrainingCreate
from physworld_storage import registry
from physworld_storage.errors import Conflict
from physworld_storage.jobs.kind import JobKind, ShardKind, ShardResult, output_of, pending_lineage
from physworld_storage.rows import required
from physworld_storage.tables import DatasetRow, JobRow, ShardRow


class TrainingResult(ShardResult):
    """Of a ``training`` shard: ``sha256`` is the digest of the version's manifest."""

    artifacts: list[Artifact]
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    metrics: dict[str, Any] = Field(default_factory=dict)


def _apply(session: Session, job: JobRow, shard: ShardRow, result: TrainingResult) -> None:
    name, version = shard.payload["name"], shard.payload["version"]
    registry.publish(
        session,
        name,
        version,
        artifacts=result.artifacts,
        sha256=result.sha256,
        metrics=result.metrics,
        lineage=result.lineage,
    )
    KIND.fulfil(job, registry.reference_id(name, version), result.sha256)


class TrainingJobs(JobKind):
    """Jobs that train; what they make is a model's version."""

    name = "training"
    unit = "steps"
    makes = "model"
    shards = (
        ShardKind(
            "training",
            queues.TRAINING,
            "physworld_services.trainer.training:run",
            TrainingResult,
            _apply,
            keeps_scratch=True,
        ),
    )

    def open(self, session: Session, request: TrainingCreate, parent: JobRow | None = None) -> JobRow:
        """The next version of a model. Raises NotFound, or Conflict when the dataset is not sealed, or when the version
        that it starts from is not ready or has another network.

        With a ``start_share`` below 1 it may still be in the making: the training waits for what it needs.
        """
        dataset = _usable(session, request)
        inputs = [Reference(kind="dataset", id=dataset.id, digest=dataset.digest)]
        if request.config.start_from is not None:
            start = start_of(session, request.config)
            inputs.append(start)
            config = request.config.model_copy(update={"start_from": start.id})
            request = request.model_copy(update={"config": config})
        job = self.queued(
            session,
            total=request.config.steps,
            inputs=inputs,
            output_id=None,
            config=request.model_dump(mode="json"),
            parent=parent,
        )
        baseline = registry.baseline_of(session, request.name, dataset, request.config)
        version = registry.allot_version(
            session,
            request.name,
            config=request.config,
            job_id=job.id,
            scene_id=dataset.scene_id,
            fit_id=dataset.fit_id,
            trace_id=dataset.trace_id,
            dataset_id=dataset.id,
            description=request.description,
            tags=request.tags,
        )
        version.lineage = pending_lineage(job)
        self.fulfil(job, registry.reference_id(version.name, version.version), None)
        payload = {
            "name": version.name,
            "version": version.version,
            "dataset_id": dataset.id,
            "fit_id": dataset.fit_id,
            "trace_id": dataset.trace_id,
            "baseline": None if baseline is None else baseline.version,
            "scene_id": dataset.scene_id,
            "config": version.config,
        }
        return self.begin(session, job, None, payload)

    def seconds(self, config: dict[str, Any]) -> float:
        """By the steps and the width of the network; reading, priors, measuring and exports are the rest."""
        asked = config["config"]
        steps = float(asked["steps"]) + 0.4 * float(asked["fine_tune_steps"])
        return 23.0 + 0.009 * float(asked["hidden"]) * steps

    def end(self, session: Session, job: JobRow, state: Unmade, message: str) -> None:
        """The version has failed or was cancelled, and says why."""
        registry.end_version(session, *_version_of(job), state, message)

    def reopen(self, session: Session, job: JobRow) -> None:
        """The version is pending again."""
        row = registry.version_row(session, *_version_of(job))
        row.state, row.message = "pending", ""

    def subject(self, job: Job) -> str | None:
        """The model that it trains."""
        return str(job.config["name"])

    def path(self, output_id: str) -> str:
        """Where the API serves the version."""
        name, _, version = output_id.rpartition(":")
        return f"models/{name}/versions/{version}"


KIND = TrainingJobs()
_SIZES = ("hidden", "message_passing_steps", "history")


def start_of(session: Session, config: TrainingConfig) -> Reference:
    """The version, by its number, whose network a training with these settings goes on from.

    Raises NotFound, or Conflict when it is not ready or its network has other sizes.
    """
    name, _, version = str(config.start_from).partition(":")
    row = registry.version_row(session, name, registry.resolve(session, name, version))
    start = Reference(kind="model", id=registry.reference_id(name, row.version), digest=row.sha256)
    if row.state != "ready":
        raise Conflict(
            f"start_from {start.id} is {row.state}; a training goes on from a version that is ready"
        )
    own, other = (
        {size: getattr(one, size) for size in _SIZES} for one in (config, registry.trained_with(row))
    )
    if own != other:
        raise Conflict(f"the network of start_from {start.id} has {other}; this one has {own}")
    return start


def _version_of(job: JobRow) -> tuple[str, int]:
    name, _, version = output_of(job).rpartition(":")
    return name, int(version)


def _usable(session: Session, request: TrainingCreate) -> DatasetRow:
    dataset = required(session, DatasetRow, request.dataset_id)
    streams = request.config.start_share < 1.0
    if dataset.state != "sealed" and not (streams and dataset.state in {"pending", "writing"}):
        needed = (
            "one that is sealed or in the making"
            if streams
            else "a sealed dataset (or a start_share below 1)"
        )
        raise Conflict(f"dataset {dataset.id} is {dataset.state}; training needs {needed}")
    return dataset
