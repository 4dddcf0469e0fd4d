"""Assessments: a new recording of an object held against a published model of it."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from physworld_schemas.base import Lineage, Request, Resource
from physworld_schemas.trace import TraceConfig

Outcome = Literal["within_noise", "as_expected", "worse_than_expected"]
Frames = Literal["all", "held_out"]


class AssessmentCreate(Request):
    """Body of POST /v1/models/{name}/versions/{version}/assessments.

    ``open_trace`` says whether a recording that the model predicts worse than expected is traced, with ``trace``.
    ``frames`` "held_out" scores the recording's held-out frames alone (its declared test frames, else the last 30 %),
    which a trace or a training that uses the recording has not seen. ``compared_with`` is another version of the same
    model that is measured on the same frames.
    """

    scene_id: str = Field(description="New recording of the model's object.")
    open_trace: bool = Field(
        default=True, description="Trace the recording where the model errs more than its card promises."
    )
    trace: TraceConfig = Field(default_factory=TraceConfig, description="Settings of that trace.")
    frames: Frames = Field(
        default="all", description="Frames that are scored: all, or the recording's held-out ones alone."
    )
    compared_with: int | None = Field(
        default=None,
        ge=1,
        lt=2**31,
        description="Another version of the model, measured on the same frames; empty: none.",
    )


class ErrorFigure(Resource):
    """A mean track error [m] with its 95 % interval, what noise alone would show, and the frames it is over."""

    error_m: float = Field(description="Mean track error.", json_schema_extra={"unit": "m"})
    ci95_m: tuple[float, float] = Field(description="Its 95 % interval.", json_schema_extra={"unit": "m"})
    noise_floor_m: float | None = Field(
        default=None,
        description="Mean error that noise alone would show; null: not known.",
        json_schema_extra={"unit": "m"},
    )
    frames: int = Field(description="Frames that the mean is over.")


class ComparedVersion(Resource):
    """Another version on the frames of an assessment.

    ``gain_m`` is its error minus that of the assessed version, frame by frame: above zero, the assessed one errs less.
    """

    version: int = Field(description="Its number.")
    measured: ErrorFigure = Field(description="Its error on the same frames.")
    twin_m: float = Field(description="Error of its twin.", json_schema_extra={"unit": "m"})
    gain_m: float = Field(
        description="Its error less that of the assessed version.", json_schema_extra={"unit": "m"}
    )
    gain_ci95_m: tuple[float, float] = Field(
        description="95 % interval of the gain, by paired blocks of frames.", json_schema_extra={"unit": "m"}
    )


class Assessment(Resource):
    """Whether a model predicts a new recording as well as it promised.

    ``measured`` is the error on the new recording, ``expected`` the held-out error of the model's card. ``excess_m``
    is the difference of the two, noise taken off each in squares, with ``excess_ci95_m``; it is above zero where the
    model errs more than noise and its card allow.
    """

    id: str = Field(description="Identifier: a prefix of its kind and 26 characters that sort by time.")
    name: str = Field(description="Name of the model.")
    version: int = Field(description="Version of the model.")
    scene_id: str = Field(description="Scene that it is about.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    state: Literal["pending", "ready", "failed", "cancelled"] = Field(
        description="Whether the answer is there."
    )
    created_at: datetime = Field(description="When it was made, UTC.")
    job_id: str = Field(description="Job that makes it.", examples=["job_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    config: dict[str, Any] = Field(default_factory=dict, description="Settings.")
    outcome: Outcome | None = Field(
        default=None, description="How the recording compares with the card; null until ready."
    )
    reason: str = Field(default="", description="The outcome in a sentence.")
    measured: ErrorFigure | None = Field(default=None, description="Error on the new recording.")
    expected: ErrorFigure | None = Field(default=None, description="Error that the card promises.")
    excess_m: float | None = Field(
        default=None,
        description="Error beyond the promised one, noise taken off.",
        json_schema_extra={"unit": "m"},
    )
    excess_ci95_m: tuple[float, float] | None = Field(
        default=None, description="Its 95 % interval.", json_schema_extra={"unit": "m"}
    )
    baselines_m: dict[str, float | None] = Field(
        default_factory=dict, description="Errors of the baselines.", json_schema_extra={"unit": "m"}
    )
    twin_m: float | None = Field(
        default=None, description="Error of the twin.", json_schema_extra={"unit": "m"}
    )
    start_mismatch_m: float | None = Field(
        default=None,
        description="Distance of the recording's start from the model's.",
        json_schema_extra={"unit": "m"},
    )
    compared: ComparedVersion | None = Field(
        default=None, description="The other version on the same frames; null: none was asked for."
    )
    trace_id: str | None = Field(default=None, description="Trace that was opened; null: none.")
    links: dict[str, str] = Field(default_factory=dict, description="Addresses of what belongs to it.")
    lineage: Lineage = Field(
        default_factory=Lineage, description="What it was made from, by which code, with which seeds."
    )
