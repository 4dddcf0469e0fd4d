"""Checks: what a recording can show of its object's parameters and of the effects, before any fit."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field

from physworld_schemas.base import RATIO, UNIT_BESIDE, Lineage, Request, Resource, Seed
from physworld_schemas.library import NamesOf

CheckState = Literal["pending", "ready", "failed", "cancelled"]
Visibility = Literal["visible", "only_if_large", "invisible"]


class CheckConfig(Request):
    """Settings of a check; the same scene and settings give the same answer.

    ``noise_m`` counts as the recording's noise; none: what the scene declares, else an estimate. ``values`` are what is
    known better of calibrated numbers than their priors, by name, in their unit. ``candidates`` are names of the
    effects' registry, none for all of them.
    """

    noise_m: float | None = Field(
        default=None,
        gt=0.0,
        le=1.0,
        allow_inf_nan=False,
        description="Noise per axis; empty: what the scene declares.",
        json_schema_extra={"unit": "m"},
    )
    discrepancy_share: float = Field(
        default=0.03,
        ge=0.0,
        lt=1.0,
        description="How far a calibrated twin is assumed to be off, over the motion's extent.",
        examples=[0.03],
        json_schema_extra=RATIO,
    )
    candidates: list[Annotated[str, NamesOf("effect")]] = Field(
        default_factory=list, max_length=64, description="Effects that are asked; empty: all."
    )
    values: dict[str, float] = Field(
        default_factory=dict, max_length=64, description="Values of calibrated numbers that are known better."
    )
    motions: int = Field(
        default=6,
        ge=0,
        le=30,
        description="Motions that are tried for what is not visible; 0: none.",
        examples=[6],
    )
    particle_budget: int = Field(
        default=500, ge=50, le=20_000, description="Particles of the twin, about.", examples=[500]
    )
    seed: Seed = Field(default=0, description="Seed of the motions that are tried.", examples=[0])


class CheckCreate(Request):
    """Body of POST /v1/checks."""

    scene_id: str = Field(
        description="Recording that is checked.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    config: CheckConfig = Field(default_factory=CheckConfig, description="Settings.")


class CheckedParameter(Resource):
    """A number that a calibration would search, with its 95 % interval before and after."""

    name: str = Field(description="Name of the number.")
    unit: str = Field(description="Its unit; `1` has none.", examples=["Pa"])
    value: float = Field(description="Value at which the check was made.", json_schema_extra=UNIT_BESIDE)
    value_is: Literal["prior", "given"] = Field(description="Where the value comes from.")
    prior95: tuple[float, float] = Field(
        description="95 % interval of what is known beforehand, in `unit`.", json_schema_extra=UNIT_BESIDE
    )
    expected95: tuple[float, float] = Field(
        description="95 % interval after a calibration, in `unit`.", json_schema_extra=UNIT_BESIDE
    )
    ratio: float = Field(
        description="Width of the second interval over the first, in the scale of the search.",
        json_schema_extra=RATIO,
    )
    optional: bool = Field(description="A calibration frees it only where data ask for it.")


class CheckedGate(Resource):
    """A strength of an effect: a plausible size, the most that is plausible, and what would be detected."""

    name: str = Field(description="Name of the strength.")
    unit: str = Field(description="Its unit; `1` has none.", examples=["1/s"])
    plausible: float = Field(description="Plausible size, in `unit`.", json_schema_extra=UNIT_BESIDE)
    most: float = Field(description="Most that is plausible, in `unit`.", json_schema_extra=UNIT_BESIDE)
    detectable: float | None = Field(
        description="Smallest strength that is detected; null: none is.", json_schema_extra=UNIT_BESIDE
    )


class CheckedEffect(Resource):
    """An effect and how large it has to be to be detected."""

    name: str = Field(description="Name of the effect.")
    label: str = Field(description="Its name, with the strength where it is asked in parts.")
    title: str = Field(description="For people.")
    status: Visibility = Field(description="Whether a plausible one would be detected.")
    multiple: float | None = Field(
        description="Multiple of a plausible one that is detected; null: none is.", json_schema_extra=RATIO
    )
    gates: list[CheckedGate] = Field(description="Its strengths.")
    shapes: int = Field(description="Shapes that were asked.")
    visible_shapes: int = Field(description="Shapes in which it is visible.")
    hidden_by: dict[str, float] = Field(
        description="Numbers that hide it: it would be visible if any one were known. With the correlation.",
        json_schema_extra=RATIO,
    )


class CheckedPair(Resource):
    """Two effects that look alike."""

    labels: tuple[str, str] = Field(description="Both effects.")
    correlation: float = Field(
        description="Of what they do beyond the calibrated numbers.", json_schema_extra=RATIO
    )
    apart_from_multiple: float | None = Field(
        description="Multiple of the plausible size from which they are told apart; null: never.",
        json_schema_extra=RATIO,
    )


class CheckView(Resource):
    """The answer under one assumption of how far the twin is off."""

    discrepancy_m: float = Field(
        description="Deviation per axis of the model's own error.", json_schema_extra={"unit": "m"}
    )
    discrepancy_share: float = Field(
        description="The same over the motion's extent.", json_schema_extra=RATIO
    )
    parameters: list[CheckedParameter] = Field(description="Numbers that a calibration would search.")
    effects: list[CheckedEffect] = Field(description="Effects of the registry.")
    pairs: list[CheckedPair] = Field(description="Effects that look alike.")
    groups: list[list[str]] = Field(description="Effects that are not told apart at plausible sizes.")


class MotionChange(Resource):
    """What a motion does for an effect or a pair: multiples of the plausible size before and after."""

    labels: list[str] = Field(description="The effect, or both effects.")
    before_multiple: float | None = Field(
        description="With this recording alone; null: never.", json_schema_extra=RATIO
    )
    after_multiple: float | None = Field(
        description="With the motion as well; null: never.", json_schema_extra=RATIO
    )
    shown: bool = Field(description="Whether the motion makes the difference.")


class ProposedMotion(Resource):
    """A further motion that shows what this recording does not."""

    description: str = Field(description="What to do, in words.")
    motion: str | None = Field(description="Family of the motion; null: none shows more.")
    times_s: list[float] = Field(description="Of the control points.", json_schema_extra={"unit": "s"})
    controllers: list[list[list[float]]] = Field(
        description="Control points, (S, K, 3).", json_schema_extra={"unit": "m"}
    )
    frame_times_s: list[float] = Field(description="Of the frames to film.", json_schema_extra={"unit": "s"})
    shows: list[MotionChange] = Field(description="Effects that are not visible now.")
    separates: list[MotionChange] = Field(description="Pairs that are taken for each other now.")
    tried: int = Field(description="Motions that were tried.")
    instead: list[str] = Field(description="What else would settle what stays open.")


class CheckReport(Resource):
    """What a check found."""

    schema_version: int = Field(default=1, description="Version of the report's form.")
    scene: str = Field(description="Name of the scene.")
    formulation: str = Field(description="Form in which the body is integrated.")
    law: str = Field(description="Elastic law.")
    noise_m: float = Field(description="Noise per axis.", json_schema_extra={"unit": "m"})
    noise_is: Literal["declared", "given", "estimated"] = Field(description="Where the noise comes from.")
    motion_m: float = Field(
        description="Root mean squared way of the points from their start, per axis.",
        json_schema_extra={"unit": "m"},
    )
    frames: int = Field(description="Frames that count.")
    views: list[CheckView] = Field(description="For a twin that is right, and for one that is off.")
    proposal: ProposedMotion | None = Field(
        default=None, description="A further motion; null: none is needed, asked for or possible."
    )
    asked: dict[str, int] = Field(description="Effects that were asked, in how many variants.")
    refused: dict[str, str] = Field(description="Effects that were not, with the reason.")
    simulations: int = Field(description="Simulations that were run.")
    seconds: float = Field(description="Wall time that it took.", json_schema_extra={"unit": "s"})


class Check(Resource):
    """A check of a scene; ``report`` is there once it is ready."""

    id: str = Field(description="Identifier: a prefix of its kind and 26 characters that sort by time.")
    scene_id: str = Field(description="Scene that it is about.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    state: CheckState = Field(description="Whether the answer is there.")
    created_at: datetime = Field(description="When it was made, UTC.")
    job_id: str = Field(description="Job that makes it.", examples=["job_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    config: CheckConfig = Field(description="Settings.")
    report: CheckReport | None = Field(default=None, description="What was found; null until ready.")
    lineage: Lineage = Field(
        default_factory=Lineage, description="What it was made from, by which code, with which seeds."
    )
