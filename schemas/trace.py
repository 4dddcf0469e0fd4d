"""Traces: a calibrated twin's residual traced to a named effect, and the twin that carries it."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from physworld_schemas.base import Artifact, Lineage, Request, Resource, Seed
from physworld_schemas.fit import FitConfig
from physworld_schemas.library import NamesOf

Verdict = Literal[
    "named", "equivalent_set", "data_issue", "numerical_issue", "unexplained", "nothing_to_explain"
]
TraceState = Literal["pending", "ready", "failed"]


class TraceConfig(Request):
    """Settings of a trace; the same scene and settings give the same answer, unless time is limited.

    ``candidates`` are names of the effects' registry, none for all of them. The best ``confirmed`` are refitted with
    the full simulator, in ``iterations`` Gauss-Newton steps; an answer has ``effects_at_most`` effects. After about
    ``time_limit_s`` seconds of one attempt, those of waiting for workers included, searches are left and the answer is
    made of what there is; none: never. ``noise_m`` counts as every recording's noise per axis in metres, for a camera
    that sees more finely than the experiment repeats; none: what scenes declare.
    """

    candidates: list[Annotated[str, NamesOf("effect")]] = Field(default_factory=list, max_length=64)
    effects_at_most: int = Field(default=2, ge=1, le=4)
    confirmed: int = Field(default=8, ge=1, le=32)
    iterations: int = Field(default=5, ge=1, le=50)
    resamples: int = Field(default=2000, ge=100, le=100_000)
    time_limit_s: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    noise_m: float | None = Field(default=None, gt=0.0, le=1.0, allow_inf_nan=False)
    seed: Seed = 0


MOST_RECORDINGS = 8
TRACE_PARTICLES = 1000
"""Coarser than a fit's: a trace runs a thousand simulations, and asks finer cells in the end."""

NO_OTHER_PHYSICS = (
    "a trace calibrates the usual elastic law, the same all over the body: fit.law, fit.plasticity, fit.formulation "
    "and fit.stages must be left out"
)


class TraceCreate(Request):
    """Body of POST /v1/traces.

    A trace calibrates the declared physics itself, with ``fit``'s budgets and mesh and never with damping. ``fit_id``
    names a ready fit of the scene: its twin is taken instead where its physics is the declared one (no damping, the
    usual law, a sheet that bends as a plate) and it has ``fit``'s number of particles and mesh.

    ``scene_ids`` are further recordings of the same object, fitted together with ``scene_id``;
    ``held_out_scene_ids`` are recordings that only the report sees.
    """

    scene_id: str
    scene_ids: list[str] = Field(default_factory=list, max_length=MOST_RECORDINGS)
    held_out_scene_ids: list[str] = Field(default_factory=list, max_length=MOST_RECORDINGS)
    fit_id: str | None = None
    fit: FitConfig = Field(default_factory=lambda: FitConfig(damping="none", particle_budget=TRACE_PARTICLES))
    config: TraceConfig = Field(default_factory=TraceConfig)

    @model_validator(mode="after")
    def _usual_physics(self) -> Self:
        if not self.fit.usual_physics:
            raise ValueError(NO_OTHER_PHYSICS)
        return self

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        every = [self.scene_id, *self.scene_ids, *self.held_out_scene_ids]
        twice = sorted({known for known in every if every.count(known) > 1})
        if twice:
            raise ValueError(
                f"a recording is fitted or held out, once: {', '.join(twice)} came more than once"
            )
        return self


class Figure(Resource):
    """A value with its unit and 95 % interval."""

    model_config = ConfigDict(extra="allow")

    value: float | None
    unit: str
    ci95: tuple[float | None, float | None] | None = None


class FoundEffect(Resource):
    """An effect of the registry with its strengths."""

    model_config = ConfigDict(extra="allow")

    name: str
    parameters: dict[str, Figure] = Field(default_factory=dict)


class Trace(Resource):
    """A trace. Once ready it holds every key of its ``report.json``, also those that are not named here.

    ``held_out`` are errors on frames that nothing before the report has seen, of the recordings that are held out if
    there are any; ``recordings`` has those of each. ``twin.npz`` is among the artifacts where an effect is
    added: one that is ``named``, or the best of an ``equivalent_set`` unless that is a fault of the measurement.
    """

    model_config = ConfigDict(extra="allow")

    id: str
    scene_id: str
    scene_ids: list[str] = Field(default_factory=list)
    held_out_scene_ids: list[str] = Field(default_factory=list)
    fit_id: str | None = None
    state: TraceState
    created_at: datetime
    job_id: str
    config: TraceConfig
    fit: FitConfig
    schema_version: int = 1
    scene: str = ""
    verdict: Verdict | None = None
    reason: str = ""
    effects: list[FoundEffect] = Field(default_factory=list)
    equivalent: list[FoundEffect] = Field(default_factory=list)
    candidates: list[dict[str, Any]] = Field(default_factory=list)
    held_out: dict[str, Any] | None = None
    recordings: list[dict[str, Any]] = Field(default_factory=list)
    calibrated: dict[str, Figure] = Field(default_factory=dict)
    unexplained: dict[str, Any] | None = None
    suggested_experiment: dict[str, Any] | None = None
    seconds: float | None = None
    simulations: int | None = None
    lineage: Lineage = Field(default_factory=Lineage)
    artifacts: list[Artifact] = Field(default_factory=list)
