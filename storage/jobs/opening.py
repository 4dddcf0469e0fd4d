"""What a new job consists of: its row, the pending resource that it will fill, its first shard, one event.

Everything of one job is made in the caller's transaction, so a job without a shard or a shard without a job
cannot be seen by anybody.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import func, insert, select
from sqlalchemy.orm import Session

from physworld_schemas.assessment import AssessmentCreate
from physworld_schemas.base import Lineage, Reference
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.ids import new_id
from physworld_schemas.job import JobKind, Progress
from physworld_schemas.model import TrainingCreate
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceConfig
from physworld_storage.changes import announce
from physworld_storage.database import DEFAULT_MAX_ATTEMPTS, MAX_ATTEMPTS
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.jobs.events import append_event
from physworld_storage.registry import allot_version, baseline_of, reference_id, version_row
from physworld_storage.tables import (
    AssessmentRow,
    DatasetRow,
    FitRow,
    JobRow,
    SceneRow,
    ShardRow,
    TraceRow,
    utc_now,
)
from physworld_storage.traces import fit_digest, trace_digest, trace_row

QUEUED, RUNNING, DONE, FAILED, CANCELLED = "QUEUED", "RUNNING", "DONE", "FAILED", "CANCELLED"
NAME_LENGTH = 64
STAGE_WINDOW = 1024
"""Shards of a stage that exist ahead of the work: enough for every worker, few enough for one short transaction."""


def open_fit(session: Session, scene_id: str, config: FitConfig, parent: JobRow | None = None) -> JobRow:
    """A fit of a scene. Raises NotFound."""
    scene = _scene(session, scene_id)
    fit_id = new_id("fit")
    job = open_job(
        session,
        "fit",
        parent=parent,
        inputs=[Reference(kind="scene", id=scene_id, digest=scene.digest)],
        outputs=[Reference(kind="fit", id=fit_id)],
        config=config.model_dump(mode="json"),
        progress=Progress(total=config.max_simulations, unit="simulations"),
    )
    row = FitRow(
        id=fit_id,
        scene_id=scene_id,
        state="pending",
        created_at=utc_now(),
        job_id=job.id,
        config=job.config,
        parameters={},
        metrics={},
        lineage=pending_lineage(job),
        artifacts=[],
    )
    session.add(row)
    add_shards(session, job, "fit", {"fit_id": fit_id, "scene_id": scene_id, "config": job.config})
    return job


def open_trace(
    session: Session,
    scene_id: str,
    fit: FitConfig,
    config: TraceConfig,
    fit_id: str | None = None,
    parent: JobRow | None = None,
    scene_ids: Sequence[str] = (),
    held_out_scene_ids: Sequence[str] = (),
) -> JobRow:
    """A trace of a scene, from a ready fit of it or its own. Raises NotFound, or Conflict when the fit does not do.

    ``scene_ids`` are fitted with the scene, ``held_out_scene_ids`` only reported on.
    """
    inputs = [
        Reference(kind="scene", id=known, digest=_scene(session, known).digest)
        for known in (scene_id, *scene_ids, *held_out_scene_ids)
    ]
    if fit_id is not None:
        known = _ready_fit(session, fit_id, "a trace")
        if known.scene_id != scene_id:
            raise Conflict(f"fit {fit_id} is of scene {known.scene_id}, not of {scene_id}")
        if (known.metrics.get("local") or {}).get("kept"):
            raise Conflict(
                f"fit {fit_id} carries a field over its body, which a trace would have to search with its effects; "
                "leave fit_id out, and the trace calibrates a homogeneous twin of its own"
            )
        inputs.append(Reference(kind="fit", id=fit_id, digest=fit_digest(known)))
    trace_id = new_id("trace")
    settings = {"fit": fit.model_dump(mode="json"), "trace": config.model_dump(mode="json")}
    others = {"scene_ids": list(scene_ids), "held_out_scene_ids": list(held_out_scene_ids)}
    job = open_job(
        session,
        "trace",
        parent=parent,
        inputs=inputs,
        outputs=[Reference(kind="trace", id=trace_id)],
        config=settings,
        progress=Progress(total=100, unit="percent"),
    )
    row = TraceRow(
        id=trace_id,
        scene_id=scene_id,
        fit_id=fit_id,
        state="pending",
        created_at=utc_now(),
        job_id=job.id,
        config=settings["trace"],
        fit=settings["fit"],
        report=others,
        lineage=pending_lineage(job),
        artifacts=[],
    )
    session.add(row)
    payload = {"trace_id": trace_id, "scene_id": scene_id, "fit_id": fit_id, **others, **settings}
    add_shards(session, job, "trace", payload)
    return job


def open_dataset(
    session: Session,
    fit_id: str,
    config: DatasetConfig,
    trace_id: str | None = None,
    parent: JobRow | None = None,
) -> JobRow:
    """A dataset of demonstrations in a ready fit, or in the twin that a trace made of it.

    Raises NotFound, or Conflict when the fit or the trace is not ready or they are of different scenes.
    """
    fit = _ready_fit(session, fit_id, "a dataset")
    inputs = [Reference(kind="fit", id=fit_id, digest=fit_digest(fit))]
    if trace_id is not None:
        trace = trace_row(session, trace_id)
        if trace.state != "ready":
            raise Conflict(f"trace {trace_id} is {trace.state}; a dataset needs a ready trace")
        if trace.scene_id != fit.scene_id:
            raise Conflict(f"trace {trace_id} is of scene {trace.scene_id}, fit {fit_id} of {fit.scene_id}")
        inputs.append(Reference(kind="trace", id=trace_id, digest=trace_digest(trace)))
    dataset_id = new_id("dataset")
    job = open_job(
        session,
        "dataset",
        parent=parent,
        inputs=inputs,
        outputs=[Reference(kind="dataset", id=dataset_id)],
        config=config.model_dump(mode="json"),
        progress=Progress(total=config.episodes, unit="episodes"),
    )
    row = DatasetRow(
        id=dataset_id,
        fit_id=fit_id,
        trace_id=trace_id,
        scene_id=fit.scene_id,
        state="pending",
        created_at=utc_now(),
        job_id=job.id,
        config=job.config,
        statistics={},
        lineage=pending_lineage(job),
        artifacts=[],
    )
    session.add(row)
    payload = {
        "dataset_id": dataset_id,
        "fit_id": fit_id,
        "trace_id": trace_id,
        "scene_id": fit.scene_id,
        "config": job.config,
    }
    add_shards(session, job, "dataset_plan", payload)
    return job


def open_training(session: Session, request: TrainingCreate, parent: JobRow | None = None) -> JobRow:
    """The next version of a model. Raises NotFound, or Conflict when the dataset is not sealed.

    With a ``start_share`` below 1 it may still be in the making: the training waits for what it needs.
    """
    dataset = session.get(DatasetRow, request.dataset_id)
    if dataset is None:
        raise NotFound("dataset", request.dataset_id)
    streams = request.config.start_share < 1.0
    if dataset.state != "sealed" and not (streams and dataset.state in {"pending", "writing"}):
        needed = (
            "one that is sealed or in the making"
            if streams
            else "a sealed dataset (or a start_share below 1)"
        )
        raise Conflict(f"dataset {dataset.id} is {dataset.state}; training needs {needed}")
    job = open_job(
        session,
        "training",
        parent=parent,
        inputs=[Reference(kind="dataset", id=dataset.id, digest=dataset.digest)],
        outputs=[],
        config=request.model_dump(mode="json"),
        progress=Progress(total=request.config.steps, unit="steps"),
    )
    baseline = baseline_of(session, request.name, dataset, request.config)
    version = allot_version(
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
    job.outputs = _plain([Reference(kind="model", id=reference_id(version.name, version.version))])
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
    add_shards(session, job, "training", payload)
    return job


def open_assessment(session: Session, name: str, version: int, request: AssessmentCreate) -> JobRow:
    """A recording held against a model version. Raises NotFound, or Conflict when the version is not ready."""
    model = version_row(session, name, version)
    if model.state != "ready" or model.fit_id is None or model.scene_id is None:
        raise Conflict(f"version {version} of {name} is {model.state}; an assessment needs a ready version")
    scene = _scene(session, request.scene_id)
    assessment_id = new_id("assessment")
    job = open_job(
        session,
        "assessment",
        parent=None,
        inputs=[
            Reference(kind="model", id=reference_id(name, version), digest=model.sha256),
            Reference(kind="scene", id=scene.id, digest=scene.digest),
        ],
        outputs=[Reference(kind="assessment", id=assessment_id)],
        config=request.model_dump(mode="json"),
        progress=Progress(total=1, unit="rollouts"),
    )
    row = AssessmentRow(
        id=assessment_id,
        name=name,
        version=version,
        scene_id=scene.id,
        state="pending",
        created_at=utc_now(),
        job_id=job.id,
        config=job.config,
        figures={},
        lineage=pending_lineage(job),
    )
    session.add(row)
    payload = {
        "assessment_id": assessment_id,
        "name": name,
        "version": version,
        "scene_id": scene.id,
        "model_scene_id": model.scene_id,
        "fit_id": model.fit_id,
        "trace_id": model.trace_id,
    }
    add_shards(session, job, "assessment", payload)
    return job


def open_pipeline(session: Session, request: PipelineCreate) -> JobRow:
    """The whole chain; its first child, the fit, is opened with it. Raises NotFound."""
    scene = _scene(session, request.scene_id)
    name = request.model_name or model_name_of(scene.name)
    job = open_job(
        session,
        "pipeline",
        parent=None,
        inputs=[Reference(kind="scene", id=scene.id, digest=scene.digest)],
        outputs=[],
        config=request.model_copy(update={"model_name": name}).model_dump(mode="json"),
        progress=Progress(total=100, unit="percent"),
    )
    open_fit(session, scene.id, request.fit, parent=job)
    return job


def add_shards(
    session: Session, job: JobRow, kind: str, payload: dict[str, Any], total: int | None = None
) -> None:
    """Put the job's present stage up for execution: one shard, or ``total`` of them that differ in their index.

    Of many only the first ``STAGE_WINDOW`` are made now, so that no transaction grows with the stage; ``add_more``
    makes the others as these are done.
    """
    job.stage_total, job.stage_done = 1 if total is None else total, 0
    payloads = (
        [payload] if total is None else [{**payload, "index": i} for i in range(min(total, STAGE_WINDOW))]
    )
    _insert_shards(session, job, kind, 0, payloads, utc_now())


def add_more(session: Session, job: JobRow, like: ShardRow) -> None:
    """Make the next shards of the stage that ``like`` belongs to, where fewer than half a window are left.

    Called under the job's lock in the transaction that commits a shard, so none is left out and none made twice.
    """
    place = (ShardRow.job_id == job.id, ShardRow.stage == job.stage, ShardRow.kind == like.kind)
    made = 1 + (session.scalar(select(func.max(ShardRow.index)).where(*place)) or 0)
    if made >= job.stage_total or made - job.stage_done > STAGE_WINDOW // 2:
        return
    indices = range(made, min(job.stage_total, job.stage_done + STAGE_WINDOW))
    payloads = [{**like.payload, "index": index} for index in indices]
    _insert_shards(session, job, like.kind, made, payloads, like.created_at)


def _insert_shards(
    session: Session, job: JobRow, kind: str, first: int, payloads: list[dict[str, Any]], at: datetime
) -> None:
    cap = session.info.get(MAX_ATTEMPTS, DEFAULT_MAX_ATTEMPTS)
    rows = [
        {
            "id": new_id("shard"),
            "job_id": job.id,
            "stage": job.stage,
            "index": first + number,
            "kind": kind,
            "state": QUEUED,
            "attempt": 0,
            "max_attempts": cap,
            "epoch": 0,
            "created_at": at,
            "payload": payload,
        }
        for number, payload in enumerate(payloads)
    ]
    session.flush()
    session.execute(insert(ShardRow), rows)
    announce(session)


def model_name_of(scene_name: str) -> str:
    """A valid model name from a scene's: lower case, other characters become dashes."""
    plain = re.sub(r"[^a-z0-9._-]+", "-", scene_name.lower()).strip("._-")
    return plain[:NAME_LENGTH] or "model"


def open_job(
    session: Session,
    kind: JobKind,
    *,
    parent: JobRow | None,
    inputs: list[Reference],
    outputs: list[Reference],
    config: dict[str, Any],
    progress: Progress,
) -> JobRow:
    """A queued job without shards yet, and its first event."""
    job = JobRow(
        id=new_id("job"),
        kind=kind,
        state="queued",
        parent_id=None if parent is None else parent.id,
        progress=progress.model_dump(),
        created_at=utc_now(),
        inputs=_plain(inputs),
        outputs=_plain(outputs),
        config=config,
    )
    job.stage = 0
    session.add(job)
    session.flush()
    append_event(session, job.id, "state", {"state": "queued"})
    if parent is not None:
        append_event(session, parent.id, "log", {"message": f"{kind} queued", "child": job.id, "kind": kind})
    return job


def _ready_fit(session: Session, fit_id: str, for_what: str) -> FitRow:
    fit = session.get(FitRow, fit_id)
    if fit is None:
        raise NotFound("fit", fit_id)
    if fit.state != "ready":
        raise Conflict(f"fit {fit_id} is {fit.state}; {for_what} needs a ready fit")
    return fit


def _scene(session: Session, scene_id: str) -> SceneRow:
    scene = session.get(SceneRow, scene_id)
    if scene is None:
        raise NotFound("scene", scene_id)
    return scene


def pending_lineage(job: JobRow) -> dict[str, Any]:
    """The lineage of what a job will bring forth, before it has."""
    return Lineage(inputs=[Reference.model_validate(item) for item in job.inputs], job_id=job.id).model_dump(
        mode="json"
    )


def _plain(references: list[Reference]) -> list[dict[str, Any]]:
    return [reference.model_dump(mode="json") for reference in references]
