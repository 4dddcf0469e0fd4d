"""Traces: a calibrated twin's residual traced to a named effect, and the twin that carries it."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from physworld_schemas.base import UNIT_BESIDE, Artifact, Lineage, Request, Resource, Seed
from physworld_schemas.fit import FURTHER, MOST_RECORDINGS, FitConfig, require_each_once
from physworld_schemas.library import NamesOf

Verdict = Literal[
    "named", "equivalent_set", "data_issue", "numerical_issue", "unexplained", "nothing_to_explain"
]
TraceState = Literal["pending", "ready", "failed", "cancelled"]


class TraceConfig(Request):
    """Settings of a trace; the same scene and settings give the same answer, unless time is limited.

    ``candidates`` are names of the effects' registry, none for all of them. Where little is left, the best
    ``confirmed`` are refitted with the full simulator, else all that promise something, in ``iterations`` Gauss-Newton
    steps; an answer has ``effects_at_most`` effects. After about ``time_limit_s`` seconds of one attempt, those of
    waiting for workers included, searches are left and the answer is
    made of what there is; none: never. ``noise_m`` counts as every recording's noise per axis in metres, for a camera
    that sees more finely than the experiment repeats; none: what scenes declare.
    """

    candidates: list[Annotated[str, NamesOf("effect")]] = Field(
        default_factory=list, max_length=64, description="Effects that may be named; empty: all."
    )
    effects_at_most: int = Field(
        default=3, ge=1, le=4, description="Most effects of an answer.", examples=[3]
    )
    confirmed: int = Field(
        default=8,
        ge=1,
        le=32,
        description="Candidates that are refitted with the full simulator where little is left.",
        examples=[8],
    )
    iterations: int = Field(
        default=5,
        ge=1,
        le=50,
        description="Gauss-Newton steps of a refit, and one more for every eight of its numbers.",
        examples=[5],
    )
    resamples: int = Field(
        default=1000, ge=100, le=100_000, description="Bootstrap resamples of an interval.", examples=[1000]
    )
    time_limit_s: float | None = Field(
        default=None,
        gt=0.0,
        allow_inf_nan=False,
        description="Time after which the answer is made of what there is; empty: none.",
        json_schema_extra={"unit": "s"},
        examples=[600.0],
    )
    noise_m: float | None = Field(
        default=None,
        gt=0.0,
        le=1.0,
        allow_inf_nan=False,
        description="Noise per axis of every recording; empty: what scenes declare.",
        json_schema_extra={"unit": "m"},
    )
    seed: Seed = Field(
        default=0,
        description="Seed of every random choice; the same seed gives the same result.",
        examples=[0],
    )


TRACE_PARTICLES = 1000
"""Coarser than a fit's: a trace runs a thousand simulations."""

NO_OTHER_PHYSICS = (
    "a trace calibrates the usual elastic law, the same all over the body: fit.law, fit.plasticity, fit.formulation "
    "and fit.stages must be left out"
)


class TraceCreate(Request):
    """Body of POST /v1/traces.

    A trace calibrates the declared physics itself, with ``fit``'s budgets and mesh and never with damping. ``fit_id``
    names a ready fit: its twin is taken instead where its physics is the declared one (no damping, the usual law, a
    sheet that bends as a plate) and it has ``fit``'s number of particles and mesh. A fit of another recording of the
    same object gives its parameters, to a body that stands where the scene starts.

    ``scene_ids`` are further recordings of the same object, fitted together with ``scene_id``;
    ``held_out_scene_ids`` are recordings that only the report sees.
    """

    scene_id: str = Field(
        description="Recording whose residual is traced.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    scene_ids: list[str] = FURTHER
    held_out_scene_ids: list[str] = Field(
        default_factory=list, max_length=MOST_RECORDINGS, description="Recordings that only the report sees."
    )
    fit_id: str | None = Field(
        default=None, description="Ready fit to start from, where its physics is the declared one."
    )
    fit: FitConfig = Field(
        default_factory=lambda: FitConfig(damping="none", particle_budget=TRACE_PARTICLES),
        description="Budgets of the trace's own calibration.",
    )
    config: TraceConfig = Field(default_factory=TraceConfig, description="Settings.")

    @model_validator(mode="after")
    def _usual_physics(self) -> Self:
        if not self.fit.usual_physics:
            raise ValueError(NO_OTHER_PHYSICS)
        return self

    @model_validator(mode="after")
    def _each_once(self) -> Self:
        require_each_once(self.scene_id, *self.scene_ids, *self.held_out_scene_ids)
        return self


class Figure(Resource):
    """A value with its unit and 95 % interval."""

    model_config = ConfigDict(extra="allow")

    value: float | None = Field(description="Value; null: not known.", json_schema_extra=UNIT_BESIDE)
    unit: str = Field(description="Unit of the value; `1` has none.", examples=["1/s"])
    ci95: tuple[float | None, float | None] | None = Field(
        default=None,
        description="95 % interval, in the same unit; null where none can be given.",
        json_schema_extra=UNIT_BESIDE,
    )


class FoundEffect(Resource):
    """An effect of the registry with its strengths."""

    model_config = ConfigDict(extra="allow")

    name: str = Field(description="Name of the effect.")
    parameters: dict[str, Figure] = Field(default_factory=dict, description="Its strengths.")


class Trace(Resource):
    """A trace. Once ready it holds every key of its ``report.json``, also those that are not named here.

    ``held_out`` are errors on frames that nothing before the report has seen, of the recordings that are held out if
    there are any; ``recordings`` has those of each. ``twin.npz`` is among the artifacts where an effect is
    added: one that is ``named``, or the best of an ``equivalent_set`` unless that is a fault of the measurement.
    """

    model_config = ConfigDict(extra="allow")

    id: str = Field(description="Identifier: a prefix of its kind and 26 characters that sort by time.")
    scene_id: str = Field(description="Scene that it is about.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    scene_ids: list[str] = Field(default_factory=list, description="Further recordings.")
    held_out_scene_ids: list[str] = Field(default_factory=list, description="Held-out recordings.")
    fit_id: str | None = Field(
        default=None, description="Fit whose twin is used.", examples=["fit_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    state: TraceState = Field(description="Whether the answer is there.")
    created_at: datetime = Field(description="When it was made, UTC.")
    job_id: str = Field(description="Job that makes it.", examples=["job_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    config: TraceConfig = Field(description="Settings.")
    fit: FitConfig = Field(description="Budgets of its calibration.")
    schema_version: int = Field(default=1, description="Version of the report's form.")
    scene: str = Field(default="", description="Name of the scene.")
    verdict: Verdict | None = Field(default=None, description="The answer; null until ready.")
    reason: str = Field(default="", description="The answer in a sentence.")
    effects: list[FoundEffect] = Field(default_factory=list, description="Effects that were added.")
    equivalent: list[FoundEffect] = Field(default_factory=list, description="Effects that do as well.")
    candidates: list[dict[str, Any]] = Field(
        default_factory=list, description="Every candidate with its score."
    )
    held_out: dict[str, Any] | None = Field(
        default=None, description="Errors on frames that no step has seen."
    )
    recordings: list[dict[str, Any]] = Field(default_factory=list, description="The same by recording.")
    calibrated: dict[str, Figure] = Field(default_factory=dict, description="Calibrated quantities.")
    unexplained: dict[str, Any] | None = Field(default=None, description="What remains.")
    suggested_experiment: dict[str, Any] | None = Field(
        default=None, description="Motion that would tell rivals apart."
    )
    seconds: float | None = Field(
        default=None, description="Wall time that it took.", json_schema_extra={"unit": "s"}
    )
    simulations: int | None = Field(default=None, description="Simulations that were run.")
    lineage: Lineage = Field(
        default_factory=Lineage, description="What it was made from, by which code, with which seeds."
    )
    artifacts: list[Artifact] = Field(
        default_factory=list, description="Files, by name and SHA-256; download them from /v1/artifacts."
    )
