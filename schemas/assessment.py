"""Assessments: a new recording of an object held against a published model of it."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from physworld_schemas.base import Lineage, Request, Resource
from physworld_schemas.trace import TraceConfig

Outcome = Literal["within_noise", "as_expected", "worse_than_expected"]


class AssessmentCreate(Request):
    """Body of POST /v1/models/{name}/versions/{version}/assessments.

    ``open_trace`` says whether a recording that the model predicts worse than expected is traced, with ``trace``.
    """

    scene_id: str
    open_trace: bool = True
    trace: TraceConfig = Field(default_factory=TraceConfig)


class ErrorFigure(Resource):
    """A mean track error [m] with its 95 % interval, what noise alone would show, and the frames it is over."""

    error_m: float
    ci95_m: tuple[float, float]
    noise_floor_m: float | None = None
    frames: int


class Assessment(Resource):
    """Whether a model predicts a new recording as well as it promised.

    ``measured`` is the error on the new recording, ``expected`` the held-out error of the model's card. ``excess_m``
    is the difference of the two, noise taken off each in squares, with ``excess_ci95_m``; it is above zero where the
    model errs more than noise and its card allow.
    """

    id: str
    name: str
    version: int
    scene_id: str
    state: Literal["pending", "ready", "failed"]
    created_at: datetime
    job_id: str
    config: dict[str, Any] = Field(default_factory=dict)
    outcome: Outcome | None = None
    reason: str = ""
    measured: ErrorFigure | None = None
    expected: ErrorFigure | None = None
    excess_m: float | None = None
    excess_ci95_m: tuple[float, float] | None = None
    baselines_m: dict[str, float | None] = Field(default_factory=dict)
    twin_m: float | None = None
    start_mismatch_m: float | None = None
    trace_id: str | None = None
    links: dict[str, str] = Field(default_factory=dict)
    lineage: Lineage = Field(default_factory=Lineage)
