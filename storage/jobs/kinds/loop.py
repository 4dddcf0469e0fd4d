"""Loops: jobs that consist of other jobs, from a recording that a model predicts badly to its next version.

::

    assessment -> trace -> dataset -> training -> assessment

The first assessment is left out where one is there already. It ends the loop where the model errs no more than its card
promises; the trace ends it where no effect is supported. The last assessment measures both versions on the held-out
frames of the new recording.

The trace fits the recording that the version's twin was calibrated on together with the new one, and with those of the
trace that the version itself came from: its twin then stands where the fit's stood, and a dataset may take it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from physworld_schemas.assessment import AssessmentCreate
from physworld_schemas.base import Reference, Unmade
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import MOST_RECORDINGS, FitConfig
from physworld_schemas.loop import LoopCreate
from physworld_schemas.model import TrainingConfig, TrainingCreate
from physworld_schemas.trace import NO_OTHER_PHYSICS, TRACE_PARTICLES
from physworld_storage.errors import Conflict
from physworld_storage.jobs.kind import JobKind, output_of
from physworld_storage.jobs.kinds import assessment, dataset, trace, training
from physworld_storage.registry import reference_id, resolve, trained_with
from physworld_storage.rows import required
from physworld_storage.tables import (
    AssessmentRow,
    DatasetRow,
    FitRow,
    JobRow,
    ModelVersionRow,
    SceneRow,
    TraceRow,
)
from physworld_storage.traces import leaves_twin

ASSESSMENT, TRACE, DATASET, TRAINING = (part.KIND.name for part in (assessment, trace, dataset, training))
WORSE = "worse_than_expected"


class LoopJobs(JobKind):
    """Jobs that close the loop on a new recording."""

    name = "loop"
    unit = "percent"
    has_children = True

    def open(self, session: Session, request: LoopCreate) -> JobRow:
        """One turn of the loop; its first child is opened with it.

        Raises NotFound, or Conflict when the version is not ready, the recording cannot be of its object, or the
        assessment that it is to begin with did not find the model worse than expected.
        """
        held = None if request.assessment_id is None else _worse(session, request.assessment_id)
        if held is not None:
            name, number, scene_id = held.name, held.version, held.scene_id
        else:
            name, scene_id = str(request.model), str(request.scene_id)
            number = resolve(session, name, request.version)
        model, scene = assessment.assessable(session, name, number), required(session, SceneRow, scene_id)
        _require_same_object(session, model, scene)
        _require_traceable(session, model, scene)
        asked = request.model_copy(update={"model": name, "version": number, "scene_id": scene_id})
        job = self.queued(
            session,
            total=100,
            inputs=[
                Reference(kind="model", id=reference_id(name, number), digest=model.sha256),
                Reference(kind="scene", id=scene.id, digest=scene.digest),
            ],
            output_id=None,
            config=asked.model_dump(mode="json"),
        )
        if held is None:
            body = AssessmentCreate(scene_id=scene_id, open_trace=False)
            assessment.KIND.open(session, name, number, body, parent=job)
        else:
            _open_trace(session, job, model, scene_id, request)
        return job

    def end(self, session: Session, job: JobRow, state: Unmade, message: str) -> None:
        """Nothing of its own: what it makes is its children's."""

    def open_next(self, session: Session, parent: JobRow, ended: JobRow, children: Sequence[JobRow]) -> bool:
        """Open what follows the child that has just ended; False when nothing does."""
        request = request_of(parent)
        model = assessment.assessable(session, str(request.model), int(request.version))
        scene_id = str(request.scene_id)
        if ended.kind == ASSESSMENT:
            worse = required(session, AssessmentRow, output_of(ended)).figures["outcome"] == WORSE
            if is_comparison(ended) or not worse:
                return False
            _open_trace(session, parent, model, scene_id, request)
        elif ended.kind == TRACE:
            if not leaves_twin(required(session, TraceRow, output_of(ended))):
                return False
            own = None if model.dataset_id is None else session.get_one(DatasetRow, model.dataset_id)
            config = request.dataset or (
                DatasetConfig() if own is None else DatasetConfig.model_validate(own.config)
            )
            dataset.KIND.open(session, str(model.fit_id), config, output_of(ended), parent=parent)
        elif ended.kind == DATASET:
            asked = TrainingCreate(
                name=model.name,
                dataset_id=output_of(ended),
                config=request.training or trained_with(model).model_copy(update={"start_from": None}),
            )
            training.KIND.open(session, asked, parent=parent)
        else:
            body = AssessmentCreate(
                scene_id=scene_id, open_trace=False, frames="held_out", compared_with=model.version
            )
            number = int(output_of(ended).rpartition(":")[2])
            assessment.KIND.open(session, model.name, number, body, parent=parent)
        return True

    def stage_opened(self, session: Session, parent: JobRow, child: JobRow) -> None:
        """Nothing: every child waits for the end of the one before."""

    def chain(self, parent: JobRow, children: Sequence[JobRow]) -> list[tuple[str, dict[str, Any]]]:
        """Kinds and configurations; dataset and training are the usual ones where they are the version's own."""
        request = request_of(parent)
        data, learning = request.dataset or DatasetConfig(), request.training or TrainingConfig()
        traced = request.trace.model_dump(mode="json")
        first: list[tuple[str, dict[str, Any]]] = (
            [(ASSESSMENT, {})] if parent.config["assessment_id"] is None else []
        )
        return [
            *first,
            (TRACE, {"fit": {"particle_budget": TRACE_PARTICLES}, "trace": traced}),
            (DATASET, data.model_dump(mode="json")),
            (TRAINING, {"config": learning.model_dump(mode="json")}),
            (ASSESSMENT, {}),
        ]


KIND = LoopJobs()


def is_comparison(job: JobRow) -> bool:
    """Whether a loop's assessment is the last one, which measures both versions."""
    return job.config["compared_with"] is not None


def request_of(job: JobRow) -> LoopCreate:
    """What a loop was asked for, with the model, the number of the version and the recording."""
    config = {**job.config, "assessment_id": None}  # by which the other three are known
    return LoopCreate.model_validate(config)


def _worse(session: Session, assessment_id: str) -> AssessmentRow:
    """A ready assessment that found its model worse than expected. Raises NotFound, Conflict."""
    row = required(session, AssessmentRow, assessment_id)
    if row.state != "ready":
        raise Conflict(f"assessment {assessment_id} is {row.state}; a loop goes on from a ready one")
    if row.figures["outcome"] != WORSE:
        raise Conflict(
            f"assessment {assessment_id} found nothing to close a loop on: {row.figures['reason']}"
        )
    return row


def _require_same_object(session: Session, model: ModelVersionRow, scene: SceneRow) -> None:
    """Raises Conflict where the recording is the model's own, or shows another kind of object or other grips."""
    home = required(session, SceneRow, str(model.scene_id))
    called = f"version {model.version} of {model.name}"
    if scene.id == home.id:
        raise Conflict(
            f"scene {scene.id} is the recording that {called} was made from; a loop needs another one"
        )
    if scene.kind != home.kind:
        raise Conflict(f"scene {scene.id} shows a {scene.kind}, {called} is of a {home.kind}")
    if scene.controllers != home.controllers:
        raise Conflict(
            f"scene {scene.id} has {scene.controllers} controllers, {called} was trained with {home.controllers}"
        )


def _require_traceable(session: Session, model: ModelVersionRow, scene: SceneRow) -> None:
    """Raises Conflict where the version's fit has another physics, or its recordings are too many."""
    fit = session.get_one(FitRow, model.fit_id)
    if not FitConfig.model_validate(fit.config).usual_physics:
        raise Conflict(f"fit {fit.id} of version {model.version} cannot be traced: {NO_OTHER_PHYSICS}")
    others = _others(session, model, scene.id)
    if len(others) > MOST_RECORDINGS:
        raise Conflict(
            f"version {model.version} of {model.name} comes from {len(others)} recordings; with scene "
            f"{scene.id} they are more than {MOST_RECORDINGS + 1}"
        )


def _others(session: Session, model: ModelVersionRow, scene_id: str) -> list[str]:
    """What is traced with the fit's first recording: what the version's fit and trace had too, and the new one."""
    known = list(session.get_one(FitRow, model.fit_id).metrics.get("scene_ids", ()))
    if model.trace_id is not None:
        known += required(session, TraceRow, model.trace_id).report.get("scene_ids", ())
    return list(dict.fromkeys([*known, scene_id]))


def _open_trace(
    session: Session, parent: JobRow, model: ModelVersionRow, scene_id: str, request: LoopCreate
) -> None:
    fit = session.get_one(FitRow, model.fit_id)
    config = FitConfig.model_validate(fit.config)
    particles = min(config.particle_budget, TRACE_PARTICLES)
    declared = config.model_copy(update={"damping": "none", "particle_budget": particles})
    trace.KIND.open(
        session,
        str(model.scene_id),
        declared,
        request.trace,
        fit.id,
        parent=parent,
        scene_ids=_others(session, model, scene_id),
    )
