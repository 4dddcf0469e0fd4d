"""The whole chain in one call: fit, trace where it is asked for, dataset, training."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, model_validator

from physworld_schemas.base import Request, Resource
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FURTHER, FitConfig, require_each_once, require_no_field
from physworld_schemas.model import TrainingConfig
from physworld_schemas.trace import NO_OTHER_PHYSICS, TraceConfig


class PipelineCreate(Request):
    """Body of POST /v1/pipelines. ``model_name`` null takes the scene's name.

    ``scene_ids`` are further recordings of the same object, fitted (and traced) together with it; demonstrations and
    figures are the first one's.

    ``close_the_loop`` traces what the fit leaves unexplained; where an effect is named, the twin that carries it
    demonstrates. ``compare`` then also trains a model on the fit's own twin, unless a version of the same name, scene
    and settings is there, so that the card can say what the effect brought.
    """

    scene_id: str = Field(
        description="Recording to make a world model of.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    scene_ids: list[str] = FURTHER
    model_name: str | None = Field(
        default=None,
        pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$",
        description="Name of the model; empty: the scene's.",
        examples=["soft_beam"],
    )
    fit: FitConfig = Field(default_factory=FitConfig, description="Calibration of the twin.")
    close_the_loop: bool = Field(
        default=False,
        description="Trace what the twin leaves unexplained; a named effect goes into the demonstrations.",
    )
    compare: bool = Field(
        default=True, description="Then also train without the effect, so that the card says what it brought."
    )
    trace: TraceConfig = Field(default_factory=TraceConfig, description="Settings of the trace.")
    dataset: DatasetConfig = Field(default_factory=DatasetConfig, description="Demonstrations.")
    training: TrainingConfig = Field(default_factory=TrainingConfig, description="World model.")

    @model_validator(mode="after")
    def _traceable(self) -> Self:
        if self.close_the_loop and not self.fit.usual_physics:
            raise ValueError(NO_OTHER_PHYSICS)
        return self

    @model_validator(mode="after")
    def _several(self) -> Self:
        require_each_once(self.scene_id, *self.scene_ids)
        require_no_field(self.fit, self.scene_ids)
        return self


class ModelReference(Resource):
    """Which model a report speaks of."""

    name: str = Field(description="Name.")
    version: int = Field(description="Number.")
    sha256: str = Field(description="SHA-256, hexadecimal.")


class RunReport(Resource):
    """The figures of one main job, under stable keys (``physworld run --json``).

    ``held_out`` maps a listed metric of ``GET /v1/metrics`` to the
    figures of ``static``, ``rigid_follow``, ``constant_velocity``, ``twin``, ``world_model`` and
    ``world_model_finetuned``. ``closed_loop`` is the card's: the verdict, the effects that were added, and the
    errors before and after; null where no trace was asked for.
    """

    schema_version: int = Field(default=1, description="Version of this form.")
    scene: str = Field(description="Name of the scene.")
    held_out: dict[str, dict[str, float | None]] = Field(description="Errors by metric and predictor.")
    noise_floor_m: float | None = Field(
        default=None,
        description="Mean error that noise alone would show; null: not known.",
        json_schema_extra={"unit": "m"},
    )
    steps_per_second: dict[str, float] = Field(
        description="Speeds by predictor.", json_schema_extra={"unit": "1/s"}
    )
    model: ModelReference = Field(description="Model that was published.")
    seconds: dict[str, float] = Field(description="Times by stage.", json_schema_extra={"unit": "s"})
    episodes: int = Field(description="Episodes.")
    parameters: dict[str, Any] = Field(default_factory=dict, description="Calibrated quantities.")
    notes: list[str] = Field(default_factory=list, description="What else to know.")
    closed_loop: dict[str, Any] | None = Field(
        default=None, description="Errors without and with the traced effect; null: no trace."
    )
