"""What follows what: stages of a job, children of a pipeline, failure and cancellation in both directions.

::

    fit        stage 0  one `fit` shard, which may put up `simulation` helpers (``storage.helpers``)
    trace      stage 0  one `trace` shard, which puts them up too
    dataset    stage 0  one `dataset_plan` shard, whose result says how many episodes follow
               stage 1  one `episode` shard each, made as the work goes on (``storage.opening.add_more``)
               stage 2  one `dataset_seal` shard
    training   stage 0  one `training` shard
    assessment stage 0  one `assessment` shard, whose result may open a trace
    rollout    stage 0  one `rollout` shard
    plan       stage 0  one `plan` shard
    pipeline   child jobs, each opened by the success of the one before (``storage.chain``)

Everything here runs in the transaction that changes the shard, under the lock of the job and, before it, of
the job's parent (``storage.locks``). Rows below a job are touched only under that lock, so two workers that finish
the last two episodes at the same moment start the next stage once.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import exists, select, update
from sqlalchemy.orm import Session

from schemas.assessment import AssessmentCreate
from schemas.base import Problem, Reference
from schemas.dataset import Episode
from schemas.fit import FitConfig
from schemas.job import TERMINAL_STATES, Progress
from schemas.trace import TRACE_PARTICLES
from storage import helpers, registry, resources, runs, traces
from storage.chain import dataset_planned, open_next, share_done
from storage.errors import Conflict
from storage.events import append_event
from storage.opening import (
    CANCELLED,
    QUEUED,
    RUNNING,
    add_more,
    add_shards,
    open_trace,
)
from storage.results import (
    AssessmentResult,
    EpisodeResult,
    FitResult,
    PlanResult,
    RunResult,
    SealResult,
    ShardResult,
    SimulationResult,
    TraceResult,
    TrainingResult,
)
from storage.tables import FitRow, JobRow, ShardRow

# Alone in their stage: their own progress is the job's.
LONG_SHARDS = frozenset({"fit", "trace", "training", "assessment", "rollout", "plan"})


def shard_started(session: Session, job: JobRow, attempt: int, now: datetime) -> None:
    """A worker took a shard: the job and its parent run."""
    job.attempt = max(job.attempt, attempt)
    for row in (_parent(session, job), job):
        if row is None:
            continue
        row.heartbeat_at = now
        if row.state == "queued":
            row.started_at = now
            _set_state(session, row, "running")


def shard_succeeded(
    session: Session, job: JobRow, shard: ShardRow, result: ShardResult, now: datetime
) -> None:
    """Apply a shard's result; when it was the stage's last, start the next stage or finish the job."""
    job.heartbeat_at = now
    if isinstance(result, SimulationResult):
        return
    job.stage_done += 1
    result.lineage.job_id = job.id
    if not result.lineage.inputs:
        result.lineage.inputs = [Reference.model_validate(item) for item in job.inputs]
    _apply(session, job, shard, result)
    if job.kind == "dataset" and isinstance(result, EpisodeResult):
        done = Progress(done=job.stage_done, total=job.stage_total, unit="episodes")
        report_progress(session, job, done)
    if job.stage_done < job.stage_total:
        add_more(session, job, shard)
    elif not _start_next_stage(session, job, shard, result):
        job.finished_at = now
        _set_state(session, job, "succeeded")
        _child_succeeded(session, job, now)


def report_progress(session: Session, job: JobRow, progress: Progress) -> None:
    """Store and log the job's progress, and what it means for its parent."""
    _set_progress(session, job, progress)
    parent = _parent(session, job)
    if parent is not None and parent.state not in TERMINAL_STATES:
        _set_progress(session, parent, _pipeline_progress(session, parent, job))


def fail_job(session: Session, job: JobRow, problem: Problem, now: datetime) -> None:
    """Fail the job with its resource and its parent; its other shards are called off."""
    _stop_shards(session, job, (QUEUED, RUNNING), now)
    job.error = problem.model_dump(mode="json")
    _fail_output(session, job, problem.detail or problem.title)
    job.finished_at = now
    _set_state(session, job, "failed")
    parent = _parent(session, job)
    if parent is not None and parent.state not in TERMINAL_STATES:
        raised = problem.model_copy(update={"detail": f"{job.kind} job {job.id}: {problem.detail}"})
        parent.error = raised.model_dump(mode="json")
        parent.finished_at = now
        _set_state(session, parent, "failed")


def request_cancel(session: Session, job: JobRow, now: datetime) -> None:
    """Cancel the job, its children and its parent. Running shards see it at their next ``renew``.

    Raises Conflict when the job has succeeded or failed; a second cancel changes nothing.
    """
    if job.state in {"succeeded", "failed"}:
        raise Conflict(f"job {job.id} has {job.state}; it can no longer be cancelled")
    root = _parent(session, job) or job
    for row in (root, *_children(session, root)):
        if row.state in TERMINAL_STATES or row.state == "cancelling":
            continue
        _stop_shards(session, row, (QUEUED,), now)
        _set_state(session, row, "cancelling")
    for row in (*_children(session, root), root):
        settle_cancel(session, row, now)


def settle_cancel(session: Session, job: JobRow, now: datetime) -> None:
    """A cancelling job with nothing running any more is cancelled; then its parent is asked the same."""
    if job.state != "cancelling":
        return
    _stop_shards(session, job, (QUEUED,), now)
    if _has_running(session, job):
        return
    if any(child.state not in TERMINAL_STATES for child in _children(session, job)):
        return
    _fail_output(session, job, "cancelled")
    job.finished_at = now
    _set_state(session, job, "cancelled")
    parent = _parent(session, job)
    if parent is not None:
        settle_cancel(session, parent, now)


def _apply(session: Session, job: JobRow, shard: ShardRow, result: ShardResult) -> None:
    payload = shard.payload
    if isinstance(result, FitResult):
        helpers.call_off(session, job.id)
        fit_id = payload["fit_id"]
        resources.mark_fit_ready(
            session, fit_id, result.parameters, result.metrics, result.artifacts, result.lineage
        )
        fit = session.get_one(FitRow, fit_id)
        _set_output(job, Reference(kind="fit", id=fit_id, digest=traces.fit_digest(fit)))
    elif isinstance(result, TraceResult):
        helpers.call_off(session, job.id)
        trace_id = payload["trace_id"]
        traces.mark_trace_ready(
            session, trace_id, result.verdict, result.report, result.artifacts, result.lineage
        )
        digest = traces.trace_digest(traces.trace_row(session, trace_id))
        _set_output(job, Reference(kind="trace", id=trace_id, digest=digest))
    elif isinstance(result, AssessmentResult):
        _apply_assessment(session, job, payload["assessment_id"], result)
    elif isinstance(result, RunResult):
        _apply_run(session, job, payload["run_id"], result)
    elif isinstance(result, PlanResult):
        resources.start_writing(session, payload["dataset_id"])
    elif isinstance(result, EpisodeResult):
        episode = Episode(**result.model_dump(include=set(Episode.model_fields)), attempt=shard.attempt)
        resources.add_episode(session, payload["dataset_id"], shard.id, episode, result.seconds)
    elif isinstance(result, SealResult):
        resources.seal_dataset(
            session,
            payload["dataset_id"],
            digest=result.digest,
            statistics=result.statistics,
            artifacts=result.artifacts,
            lineage=result.lineage,
        )
        _set_output(job, Reference(kind="dataset", id=payload["dataset_id"], digest=result.digest))
    elif isinstance(result, TrainingResult):
        name, version = payload["name"], payload["version"]
        registry.publish(
            session,
            name,
            version,
            artifacts=result.artifacts,
            sha256=result.sha256,
            metrics=result.metrics,
            lineage=result.lineage,
        )
        output = Reference(kind="model", id=registry.reference_id(name, version), digest=result.sha256)
        _set_output(job, output)


def _apply_assessment(session: Session, job: JobRow, assessment_id: str, result: AssessmentResult) -> None:
    """Keep the figures; a recording that the model predicts worse than expected is traced, if that was asked for."""
    figures = result.model_dump(mode="json", exclude={"lineage"})
    row = traces.mark_assessment_ready(session, assessment_id, figures, result.lineage)
    request = AssessmentCreate.model_validate(job.config)
    if result.outcome != "worse_than_expected" or not request.open_trace:
        return
    declared = FitConfig(damping="none", particle_budget=TRACE_PARTICLES)
    opened = open_trace(session, row.scene_id, declared, request.trace)
    row.trace_id = opened.outputs[0]["id"]
    job.outputs = [*job.outputs, *opened.outputs]
    append_event(session, job.id, "log", {"message": "trace queued", "child": opened.id, "kind": "trace"})


def _apply_run(session: Session, job: JobRow, run_id: str, result: RunResult) -> None:
    """Keep the figures and files of a rollout or a plan."""
    kind: runs.RunKind = "plan" if job.kind == "plan" else "rollout"
    runs.mark_run_ready(session, kind, run_id, result.figures, result.artifacts, result.lineage)
    _set_output(job, Reference(kind=kind, id=run_id, digest=runs.run_digest(result.artifacts, kind)))


def _start_next_stage(session: Session, job: JobRow, shard: ShardRow, result: ShardResult) -> bool:
    """Open what follows the stage that ended with this shard; False when nothing does."""
    if isinstance(result, PlanResult):
        job.stage += 1
        plan = {"frames": result.frames, "particles": result.particles}
        add_shards(session, job, "episode", {**shard.payload, "plan": plan}, result.episodes)
        report_progress(session, job, Progress(done=0, total=result.episodes, unit="episodes"))
        parent = _parent(session, job)
        if parent is not None:
            dataset_planned(session, parent, shard.payload["dataset_id"])
        return True
    if isinstance(result, EpisodeResult):
        job.stage += 1
        base = {key: value for key, value in shard.payload.items() if key not in {"index", "plan"}}
        add_shards(session, job, "dataset_seal", base)
        return True
    return False


def _child_succeeded(session: Session, child: JobRow, now: datetime) -> None:
    """Open the pipeline's next child, or finish the pipeline."""
    parent = _parent(session, child)
    if parent is None or parent.state in TERMINAL_STATES:  # what ran beside this child has failed
        return
    parent.heartbeat_at = now
    parent.outputs = [*parent.outputs, *child.outputs]
    message = f"{child.kind} done"
    append_event(session, parent.id, "log", {"message": message, "child": child.id, "kind": child.kind})
    progress = _pipeline_progress(session, parent, child)
    _set_progress(session, parent, progress.model_copy(update={"message": message}))
    if not open_next(session, parent, child, _children(session, parent)):
        parent.finished_at = now
        _set_state(session, parent, "succeeded")


def _pipeline_progress(session: Session, parent: JobRow, active: JobRow) -> Progress:
    share = share_done(parent, _children(session, parent))
    own = Progress.model_validate(active.progress)
    message = f"{active.kind}: {own.done:g} of {own.total:g} {own.unit}"
    return Progress(done=round(100 * share, 2), total=100, unit="percent", message=message)


def _set_progress(session: Session, job: JobRow, progress: Progress) -> None:
    job.progress = progress.model_dump()
    append_event(session, job.id, "progress", job.progress)


def _set_state(session: Session, job: JobRow, state: str) -> None:
    job.state = state
    data: dict[str, Any] = {"state": state}
    if job.error is not None:
        data["error"] = job.error
    append_event(session, job.id, "state", data)
    session.flush()


def _set_output(job: JobRow, output: Reference) -> None:
    job.outputs = [output.model_dump(mode="json")]


def _fail_output(session: Session, job: JobRow, message: str) -> None:
    if job.kind == "pipeline":
        return
    output = job.outputs[0]["id"]
    if job.kind == "fit":
        resources.fail_fit(session, output)
    elif job.kind == "trace":
        traces.fail_trace(session, output)
    elif job.kind == "assessment":
        traces.fail_assessment(session, output)
    elif job.kind == "rollout" or job.kind == "plan":
        runs.fail_run(session, "plan" if job.kind == "plan" else "rollout", output)
    elif job.kind == "dataset":
        resources.fail_dataset(session, output)
    else:
        name, _, version = output.rpartition(":")
        registry.fail_version(session, name, int(version), message)


def _stop_shards(session: Session, job: JobRow, states: tuple[str, ...], now: datetime) -> None:
    session.execute(
        update(ShardRow)
        .where(ShardRow.job_id == job.id, ShardRow.state.in_(states))
        .values(state=CANCELLED, lease_owner=None, lease_until=None, finished_at=now)
    )


def _has_running(session: Session, job: JobRow) -> bool:
    running = exists().where(ShardRow.job_id == job.id, ShardRow.state == RUNNING)
    return bool(session.scalar(select(running)))


def _parent(session: Session, job: JobRow) -> JobRow | None:
    """The parent, which ``storage.locks.lock_job`` has locked and loaded."""
    return None if job.parent_id is None else session.get_one(JobRow, job.parent_id)


def _children(session: Session, job: JobRow) -> list[JobRow]:
    if job.kind != "pipeline":
        return []
    order = (JobRow.created_at, JobRow.id)
    statement = select(JobRow).where(JobRow.parent_id == job.id).order_by(*order)
    return list(session.scalars(statement.execution_options(populate_existing=True)))
