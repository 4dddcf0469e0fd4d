"""Pipelines: jobs that consist of other jobs.

::

    fit -> dataset -> training                                           without a trace
    fit -> trace -> dataset -> training                                  ``close_the_loop``, nothing added
    fit -> trace -> dataset -> training -> dataset -> training           ... an effect added: first on the fit's own
                                                                         twin, for comparison, then with the effect

A training whose ``start_share`` is below 1 is opened as soon as its dataset is planned, and runs beside it.

The comparison is left out when it was not asked for (``compare``) or when a ready version of the same name on an equal
twin with the same settings is there already.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from physworld_schemas.base import Reference, Unmade
from physworld_schemas.job import TERMINAL_STATES
from physworld_schemas.model import TrainingCreate
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TRACE_PARTICLES
from physworld_storage.jobs.kind import JobKind, output_of
from physworld_storage.jobs.kinds import dataset, fit, trace, training
from physworld_storage.registry import find_baseline
from physworld_storage.rows import required
from physworld_storage.tables import JobRow, SceneRow, TraceRow
from physworld_storage.traces import leaves_twin

FIT, TRACE, DATASET, TRAINING = (part.KIND.name for part in (fit, trace, dataset, training))
NAME_LENGTH = 64


class PipelineJobs(JobKind):
    """Jobs that run the whole chain from a scene to a published model."""

    name = "pipeline"
    unit = "percent"
    has_children = True
    decisive = ("close_the_loop", "compare")

    def open(self, session: Session, request: PipelineCreate) -> JobRow:
        """The whole chain; its first child, the fit, is opened with it. Raises NotFound, and what ``start_of`` does."""
        scene = required(session, SceneRow, request.scene_id)
        name = request.model_name or model_name_of(scene.name)
        inputs = [
            Reference(kind="scene", id=known, digest=required(session, SceneRow, known).digest)
            for known in (request.scene_id, *request.scene_ids)
        ]
        if request.training.start_from is not None:
            start = training.start_of(session, request.training)
            inputs.append(start)
            learning = request.training.model_copy(update={"start_from": start.id})
            request = request.model_copy(update={"training": learning})
        job = self.queued(
            session,
            total=100,
            inputs=inputs,
            output_id=None,
            config=request.model_copy(update={"model_name": name}).model_dump(mode="json"),
        )
        fit.KIND.open(session, scene.id, request.fit, job, request.scene_ids)
        return job

    def end(self, session: Session, job: JobRow, state: Unmade, message: str) -> None:
        """Nothing of its own: what it makes is its children's."""

    def open_next(self, session: Session, parent: JobRow, ended: JobRow, children: Sequence[JobRow]) -> bool:
        """Open what follows the child that has just ended, when all have succeeded; False when nothing does.

        Times say nothing of what followed what: children are made by several hosts, whose clocks may differ and be set.
        """
        if any(job.state not in TERMINAL_STATES for job in children):
            return True  # a training runs beside its dataset; the end of the later one decides
        request = PipelineCreate.model_validate(parent.config)
        outputs = {job.kind: output_of(job) for job in (*children, ended)}
        last = ended.kind
        if last == DATASET and _has_training(children, outputs[DATASET]):
            last = TRAINING  # it ran beside its dataset and ended first
        if last == FIT and request.close_the_loop:
            particles = min(request.fit.particle_budget, TRACE_PARTICLES)
            declared = request.fit.model_copy(update={"damping": "none", "particle_budget": particles})
            trace.KIND.open(
                session,
                request.scene_id,
                declared,
                request.trace,
                outputs[FIT],
                parent=parent,
                scene_ids=request.scene_ids,
            )
        elif last == DATASET:
            _open_training(session, parent, request, outputs[DATASET])
        elif last == TRAINING and not _is_comparison(session, children):
            return False
        else:
            traced = required(session, TraceRow, outputs[TRACE]) if TRACE in outputs else None
            own = (
                last == TRACE and traced is not None and _wants_comparison(session, request, traced, outputs)
            )
            trace_id = None if traced is None or own else traced.id
            dataset.KIND.open(session, outputs[FIT], request.dataset, trace_id, parent=parent)
        return True

    def stage_opened(self, session: Session, parent: JobRow, child: JobRow) -> None:
        """Open the training beside a dataset whose episodes are about to be made, where it need not wait for them."""
        if child.kind != DATASET or child.stage != dataset.WRITING:
            return
        request = PipelineCreate.model_validate(parent.config)
        if request.training.start_share < 1.0:
            _open_training(session, parent, request, output_of(child))

    def chain(self, parent: JobRow, children: Sequence[JobRow]) -> list[tuple[str, dict[str, Any]]]:
        """Kinds and configurations; a comparison counts until a dataset without one has been opened."""
        asked = parent.config
        model = [(DATASET, asked["dataset"]), (TRAINING, {"config": asked["training"]})]
        if not asked["close_the_loop"]:
            return [(FIT, asked["fit"]), *model]
        first = next((job for job in children if job.kind == DATASET), None)
        compares = asked["compare"] and (first is None or not _is_traced(first))
        particles = min(asked["fit"]["particle_budget"], TRACE_PARTICLES)
        traced = {"fit": {**asked["fit"], "particle_budget": particles}, "trace": asked["trace"]}
        return [(FIT, asked["fit"]), (TRACE, traced), *model, *(model if compares else ())]


KIND = PipelineJobs()


def model_name_of(scene_name: str) -> str:
    """A valid model name from a scene's: lower case, other characters become dashes."""
    plain = re.sub(r"[^a-z0-9._-]+", "-", scene_name.lower()).strip("._-")
    return plain[:NAME_LENGTH] or "model"


def _open_training(session: Session, parent: JobRow, request: PipelineCreate, dataset_id: str) -> None:
    name = request.model_name or ""
    asked = TrainingCreate(name=name, dataset_id=dataset_id, config=request.training)
    training.KIND.open(session, asked, parent=parent)


def _wants_comparison(
    session: Session, request: PipelineCreate, traced: TraceRow, outputs: dict[str, str]
) -> bool:
    if not request.compare or not leaves_twin(traced):
        return False
    settings = request.dataset.model_dump(mode="json")
    name = request.model_name or ""
    return find_baseline(session, name, outputs[FIT], settings, request.training) is None


def _has_training(children: Sequence[JobRow], dataset_id: str) -> bool:
    """Whether one of the jobs is a training on this dataset."""
    return any(job.kind == TRAINING and job.inputs[0]["id"] == dataset_id for job in children)


def _is_comparison(session: Session, children: Sequence[JobRow]) -> bool:
    """Whether the training that has just ended was the one without the effects that the trace added."""
    kinds = [job.kind for job in children]
    if TRACE not in kinds or kinds.count(TRAINING) > 1:
        return False
    traced = required(session, TraceRow, output_of(children[kinds.index(TRACE)]))
    last_dataset = next(job for job in reversed(children) if job.kind == DATASET)
    return leaves_twin(traced) and not _is_traced(last_dataset)


def _is_traced(job: JobRow) -> bool:
    """Whether a dataset is of a trace's twin."""
    return any(item["kind"] == "trace" for item in job.inputs)
