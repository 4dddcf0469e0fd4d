"""What can be started from a page: the body that its form asks for, what may be chosen, and what opens the job.

Most bodies are those of the REST API. A rollout and a plan need arrays, which nobody types: their forms ask for a
motion or a displacement, and the arrays are made of the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, Field
from sqlalchemy.orm import Session

from physworld_schemas.arrays import EncodedArray
from physworld_schemas.assessment import AssessmentCreate
from physworld_schemas.base import Request as Body
from physworld_schemas.check import CheckCreate
from physworld_schemas.dataset import DatasetCreate
from physworld_schemas.fit import FitCreate
from physworld_schemas.job import Job
from physworld_schemas.loop import LoopCreate
from physworld_schemas.model import TrainingCreate
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.plan import PlanConfig, PlanCreate, PlanLimits, PointGoal
from physworld_schemas.rollout import ModelName, RolloutCreate, Version
from physworld_schemas.trace import TraceConfig, TraceCreate
from physworld_schemas.video import VideoCreate
from physworld_services.api.routes.library import require_known
from physworld_services.api.routes.plans import plan_opening
from physworld_services.api.routes.rollouts import rollout_opening
from physworld_services.dashboard.site import Site
from physworld_storage import overview, registry, resources, traces
from physworld_storage.errors import NotFound
from physworld_storage.jobs import jobs

MOST_CHOICES = 200
MADE_OF = {"rollout": {"motion_scale"}, "plan": {"shift_x_m", "shift_y_m", "shift_z_m"}}
"""Fields of forms that arrays are made of, by the kind of the job, which keeps them beside its settings."""

Opening = Callable[[Session], Job]


class AssessmentForm(AssessmentCreate):
    """Hold a new recording of an object against a model of it."""

    model: ModelName = Field(description="Model of the object.")
    version: Version = Field(default="latest", description="Number, alias or `latest`.")


class LoopForm(Body):
    """Trace a recording that a model predicts badly, and train the next version on what is found."""

    model: ModelName = Field(description="Model of the object.")
    version: Version = Field(default="latest", description="Number, alias or `latest`.")
    scene_id: str = Field(description="New recording of the object.")
    trace: TraceConfig = Field(default_factory=TraceConfig, description="Settings of the trace.")


class RolloutForm(Body):
    """Predict what the object does under the recording's own motion, larger, smaller, or held still."""

    model: ModelName = Field(description="Model that predicts.")
    version: Version = Field(default="latest", description="Number, alias or `latest`.")
    motion_scale: float = Field(
        default=1.0,
        ge=0.0,
        le=3.0,
        description="The grips' displacement relative to the recorded one; 0 holds them.",
    )
    stiffness_factor: float = Field(
        default=1.0, ge=0.01, le=100, description="Stiffness relative to the calibrated one."
    )
    density_factor: float = Field(
        default=1.0, ge=0.01, le=100, description="Density relative to the calibrated one."
    )


class PlanForm(Body):
    """Find a motion of the grips that shifts the object's measured points."""

    model: ModelName = Field(description="Model that plans.")
    version: Version = Field(default="latest", description="Number, alias or `latest`.")
    shift_x_m: float = Field(
        default=0.0, ge=-1.0, le=1.0, description="How far along x.", json_schema_extra={"unit": "m"}
    )
    shift_y_m: float = Field(
        default=0.0, ge=-1.0, le=1.0, description="How far along y.", json_schema_extra={"unit": "m"}
    )
    shift_z_m: float = Field(
        default=0.05, ge=-1.0, le=1.0, description="How far upwards.", json_schema_extra={"unit": "m"}
    )
    config: PlanConfig = Field(default_factory=PlanConfig, description="Settings of the search.")


@dataclass(frozen=True)
class Start:
    """One kind of job that a person can start."""

    title: str
    told: str
    body: type[BaseModel]
    open: Callable[[Site, Any], Opening]


def _pipeline(site: Site, body: PipelineCreate) -> Opening:
    require_known(fit=body.fit, trace=body.trace)
    return lambda session: jobs.create_pipeline(session, body)


def _fit(site: Site, body: FitCreate) -> Opening:
    require_known(config=body.config)
    return lambda session: jobs.create_fit(session, body.scene_id, body.config, scene_ids=body.scene_ids)


def _check(site: Site, body: CheckCreate) -> Opening:
    require_known(config=body.config)
    return lambda session: jobs.create_check(session, body)


def _video(site: Site, body: VideoCreate) -> Opening:
    return lambda session: jobs.create_video(session, body)


def _trace(site: Site, body: TraceCreate) -> Opening:
    require_known(config=body.config)
    return lambda session: jobs.create_trace(session, body)


def _dataset(site: Site, body: DatasetCreate) -> Opening:
    return lambda session: jobs.create_dataset(session, body.fit_id, body.config, body.trace_id)


def _training(site: Site, body: TrainingCreate) -> Opening:
    return lambda session: jobs.create_training(session, body)


def _assessment(site: Site, body: AssessmentForm) -> Opening:
    request = AssessmentCreate(**body.model_dump(exclude={"model", "version"}))

    def opening(session: Session) -> Job:
        number = registry.resolve(session, body.model, body.version)
        return jobs.create_assessment(session, body.model, number, request)

    return opening


def _loop(site: Site, body: LoopForm) -> Opening:
    require_known(trace=body.trace)
    request = LoopCreate(model=body.model, version=body.version, scene_id=body.scene_id, trace=body.trace)
    return lambda session: jobs.create_loop(session, request)


def _rollout(site: Site, body: RolloutForm) -> Opening:
    recording = _recording_of(site, body.model, body.version)
    start = recording.controllers[:1]
    asked = RolloutCreate(
        model=body.model,
        version=body.version,
        controllers=EncodedArray.of(start + body.motion_scale * (recording.controllers - start)),
        times=[float(time) for time in recording.times],
        stiffness_factor=body.stiffness_factor,
        density_factor=body.density_factor,
        returns=["points", "vertices"],
        mode="job",
    )
    return rollout_opening(asked, site.database, site.stores, body.model_dump(include=MADE_OF["rollout"]))


def _plan(site: Site, body: PlanForm) -> Opening:
    recording = _recording_of(site, body.model, body.version)
    seen = np.flatnonzero(recording.visible[0])
    places = recording.points[0, seen] + np.array([body.shift_x_m, body.shift_y_m, body.shift_z_m])
    goal = PointGoal(
        kind="points",
        index=[int(point) for point in seen],
        places=[tuple(place) for place in places.tolist()],
    )
    asked = PlanCreate(
        model=body.model, version=body.version, goal=goal, limits=PlanLimits(), config=body.config
    )
    return plan_opening(asked, site.database, site.stores, body.model_dump(include=MADE_OF["plan"]))


STARTS: dict[str, Start] = {
    "pipeline": Start(
        "Make a world model",
        "The whole chain: calibrate, demonstrate, train, measure.",
        PipelineCreate,
        _pipeline,
    ),
    "fit": Start(
        "Calibrate a twin", "A simulation of one recording, its parameters with intervals.", FitCreate, _fit
    ),
    "check": Start(
        "Check a recording",
        "What can its motion show, before anything is fitted?",
        CheckCreate,
        _check,
    ),
    "trace": Start(
        "Trace what is missing",
        "Which physical effect accounts for what the calibrated twin leaves unexplained?",
        TraceCreate,
        _trace,
    ),
    "dataset": Start(
        "Demonstrate", "Episodes that a calibrated twin plays out under new motions.", DatasetCreate, _dataset
    ),
    "training": Start(
        "Train a model", "A graph network, trained on a sealed dataset.", TrainingCreate, _training
    ),
    "assessment": Start(
        "Assess a recording", "Does a published model still predict its object?", AssessmentForm, _assessment
    ),
    "loop": Start(
        "Close the loop",
        "From a recording that a model predicts badly to its next version, with the errors of both.",
        LoopForm,
        _loop,
    ),
    "rollout": Start(
        "Predict a motion", "Open loop, from the start of the recording.", RolloutForm, _rollout
    ),
    "video": Start(
        "Draw a film",
        "A recording, a twin, a prediction or a rollout, as a camera sees it.",
        VideoCreate,
        _video,
    ),
    "plan": Start(
        "Plan a motion", "Grips move so that the object reaches a goal; checked in the twin.", PlanForm, _plan
    ),
}


def choices_of(site: Site) -> dict[str, list[tuple[str, str]]]:
    """What may be chosen for the fields that name an object: (id, words), the newest first."""
    with site.database.reading() as session:
        scenes = resources.list_scenes(session, limit=MOST_CHOICES).data
        fits = resources.list_fits(session, limit=MOST_CHOICES, state="ready").data
        datasets = resources.list_datasets(session, limit=MOST_CHOICES, state="sealed").data
        traced = traces.list_traces(session, limit=MOST_CHOICES, state="ready").data
        models = registry.list_models(session, limit=MOST_CHOICES).data
        about = [item.scene_id for item in fits] + [item.scene_id for item in datasets]
        about += [item.scene_id for item in traced]
        names = overview.scene_names(session, about)
    listed = [(scene.id, f"{scene.name} (…{scene.id[-6:]})") for scene in scenes]
    return {
        "scene_id": listed,
        "scene_ids": listed,
        "held_out_scene_ids": listed,
        "fit_id": [(item.id, f"{names.get(item.scene_id, '?')} (…{item.id[-6:]})") for item in fits],
        "dataset_id": [
            (item.id, f"{names.get(item.scene_id, '?')}, {item.episodes_done} episodes (…{item.id[-6:]})")
            for item in datasets
        ],
        "trace_id": [
            (item.id, f"{names.get(item.scene_id, '?')}, {item.verdict} (…{item.id[-6:]})") for item in traced
        ],
        "model": [(model.name, model.name) for model in models],
    }


def body_of(job: Job) -> dict[str, Any]:
    """What a job was asked for, as the form of its kind shows it, to be started again with other settings."""
    given: dict[str, list[str]] = {}
    for reference in job.inputs:
        given.setdefault(reference.kind, []).append(reference.id)
    first: Mapping[str, str] = {kind: ids[0] for kind, ids in given.items()}
    if job.kind == "check":
        return {"scene_id": first.get("scene"), "config": job.config}
    if job.kind == "fit":
        return {"scene_id": first.get("scene"), "scene_ids": given["scene"][1:], "config": job.config}
    if job.kind == "trace":
        own = {"fit": job.config.get("fit"), "config": job.config.get("trace")}
        return {"scene_id": first.get("scene"), "fit_id": first.get("fit"), **own}
    if job.kind == "dataset":
        return {"fit_id": first.get("fit"), "trace_id": first.get("trace"), "config": job.config}
    if job.kind == "assessment":
        name, _, version = first.get("model", "").rpartition(":")
        return {**job.config, "scene_id": first.get("scene"), "model": name, "version": version}
    if job.kind == "loop":
        return {name: job.config[name] for name in LoopForm.model_fields}
    return dict(job.config)


def not_taken_over(job: Job) -> str:
    """What a job was asked for and its form cannot show, in a sentence; empty where it shows everything."""
    if MADE_OF.get(job.kind, set()) <= job.config.keys():
        return ""
    asked, shown = {
        "rollout": ("The motion of this rollout", "the recording's own"),
        "plan": ("The goal of this plan", "a shift of the measured points"),
    }[job.kind]
    return f"{asked} was given as arrays, which a form does not show: it begins with {shown}."


def _recording_of(site: Site, name: str, version: str | int) -> Any:
    with site.database.reading() as session:
        found = registry.get_version(session, name, version)
        record = resources.get_scene(session, str(found.scene_id))
    recording = site.recording(record.artifacts)
    if recording is None:
        raise NotFound("archive of scene", record.id)
    return recording
