"""Loops: from a recording that a model predicts badly to a new version of the model, with the errors of both."""

from __future__ import annotations

from datetime import datetime
from typing import Literal, Self

from pydantic import Field, model_validator

from physworld_schemas.assessment import ErrorFigure
from physworld_schemas.base import Problem, Request, Resource
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.job import JobState, Progress
from physworld_schemas.model import TrainingConfig
from physworld_schemas.rollout import ModelName, Version
from physworld_schemas.trace import FoundEffect, TraceConfig, Verdict

LoopOutcome = Literal["as_expected", "no_effect", "improved", "not_improved"]


class LoopCreate(Request):
    """Body of POST /v1/loops: either ``model`` and ``scene_id``, or ``assessment_id`` alone.

    The version is held against the recording first, unless a ready assessment is named that found it worse than
    expected. The recording is traced together with the one that the version's twin was calibrated on. Where the trace
    supports an effect, the twin that carries it demonstrates and the next version is trained. ``dataset`` and
    ``training`` that are left out are those of the version.
    """

    model: ModelName | None = Field(default=None, description="Name of the model.", examples=["soft_beam"])
    version: Version = Field(default="latest", description="Number, alias or `latest`.")
    scene_id: str | None = Field(
        default=None,
        description="New recording of the model's object.",
        examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"],
    )
    assessment_id: str | None = Field(
        default=None,
        description="Ready assessment to go on from, instead of model and recording.",
        examples=["ass_01JZ8Q5V3M7X2K9T4B6N8R0C1D"],
    )
    trace: TraceConfig = Field(default_factory=TraceConfig, description="Settings of the trace.")
    dataset: DatasetConfig | None = Field(default=None, description="Demonstrations; empty: the version's.")
    training: TrainingConfig | None = Field(default=None, description="World model; empty: the version's.")

    @model_validator(mode="after")
    def _one_beginning(self) -> Self:
        recording = self.model is not None and self.scene_id is not None
        neither = self.model is None and self.scene_id is None
        if self.assessment_id is None and not recording:
            raise ValueError("model and scene_id are needed, or an assessment_id")
        if self.assessment_id is not None and not (neither and self.version == "latest"):
            raise ValueError(
                "an assessment_id says model, version and scene_id itself: these must be left out"
            )
        return self


class VersionError(Resource):
    """Error of one version on the new recording's held-out frames."""

    version: int = Field(description="Number of the version.")
    measured: ErrorFigure = Field(description="Its error.")
    twin_m: float | None = Field(
        default=None, description="Error of its twin.", json_schema_extra={"unit": "m"}
    )


class Loop(Resource):
    """One turn of the loop; its id is that of its job.

    ``outcome``: "as_expected", the version predicts the recording as well as its card promises; "no_effect", the trace
    supports no effect, ``verdict`` says which; "improved", the new version errs less, the interval of ``gain_m`` above
    zero; "not_improved", it does not. Only the last two leave a ``new_version``.

    All errors are over the recording's held-out frames, which neither trace nor training has seen.
    """

    id: str = Field(description="Identifier of the loop and of its job.")
    model: str = Field(description="Name of the model.")
    version: int = Field(description="Version that the loop began with.")
    scene_id: str = Field(description="The new recording.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    state: JobState = Field(description="Where it is.")
    created_at: datetime = Field(description="When it was made, UTC.")
    finished_at: datetime | None = Field(default=None, description="When it ended.")
    progress: Progress = Field(default_factory=Progress, description="How far it is.")
    outcome: LoopOutcome | None = Field(default=None, description="How it ended; null until it has.")
    reason: str = Field(default="", description="The outcome in a sentence.")
    assessment_id: str | None = Field(default=None, description="Assessment that it began with.")
    trace_id: str | None = Field(default=None, description="Its trace; null: none was opened.")
    verdict: Verdict | None = Field(default=None, description="Answer of the trace; null: none yet.")
    effects: list[FoundEffect] = Field(default_factory=list, description="Effects that were added.")
    dataset_id: str | None = Field(default=None, description="Demonstrations of the new twin.")
    new_version: int | None = Field(default=None, description="Version that was made; null: none.")
    comparison_id: str | None = Field(default=None, description="Assessment that measured both versions.")
    before: VersionError | None = Field(default=None, description="Error of the version it began with.")
    after: VersionError | None = Field(default=None, description="Error of the new version.")
    gain_m: float | None = Field(
        default=None, description="Error before less error after.", json_schema_extra={"unit": "m"}
    )
    gain_ci95_m: tuple[float, float] | None = Field(
        default=None, description="Its 95 % interval, by paired blocks.", json_schema_extra={"unit": "m"}
    )
    baselines_m: dict[str, float | None] = Field(
        default_factory=dict,
        description="Errors of the baselines on the same frames.",
        json_schema_extra={"unit": "m"},
    )
    error: Problem | None = Field(default=None, description="Why it failed; null: it did not.")
    links: dict[str, str] = Field(default_factory=dict, description="Addresses of what belongs to it.")
