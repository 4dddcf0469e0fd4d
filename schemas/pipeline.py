"""The whole chain in one call: fit, trace where it is asked for, dataset, training."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, model_validator

from physworld_schemas.base import Request, Resource
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.model import TrainingConfig
from physworld_schemas.trace import NO_OTHER_PHYSICS, TraceConfig


class PipelineCreate(Request):
    """Body of POST /v1/pipelines. ``model_name`` null takes the scene's name.

    ``close_the_loop`` traces what the fit leaves unexplained; where an effect is named, the twin that carries it
    demonstrates. ``compare`` then also trains a model on the fit's own twin, unless a version of the same name, scene
    and settings is there, so that the card can say what the effect brought.
    """

    scene_id: str
    model_name: str | None = Field(default=None, pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$")
    fit: FitConfig = Field(default_factory=FitConfig)
    close_the_loop: bool = False
    compare: bool = True
    trace: TraceConfig = Field(default_factory=TraceConfig)
    dataset: DatasetConfig = Field(default_factory=DatasetConfig)
    training: TrainingConfig = Field(default_factory=TrainingConfig)

    @model_validator(mode="after")
    def _traceable(self) -> Self:
        if self.close_the_loop and not self.fit.usual_physics:
            raise ValueError(NO_OTHER_PHYSICS)
        return self


class ModelReference(Resource):
    """Which model a report speaks of."""

    name: str
    version: int
    sha256: str


class RunReport(Resource):
    """The figures of one main job, under stable keys (``physworld run --json``).

    ``held_out`` maps a listed metric of ``GET /v1/metrics`` to the
    figures of ``static``, ``rigid_follow``, ``constant_velocity``, ``twin``, ``world_model`` and
    ``world_model_finetuned``. ``closed_loop`` is the card's: the verdict, the effects that were added, and the
    errors before and after; null where no trace was asked for.
    """

    schema_version: int = 1
    scene: str
    held_out: dict[str, dict[str, float | None]]
    noise_floor_m: float | None = None
    steps_per_second: dict[str, float]
    model: ModelReference
    seconds: dict[str, float]
    episodes: int
    parameters: dict[str, Any] = Field(default_factory=dict)
    notes: list[str] = Field(default_factory=list)
    closed_loop: dict[str, Any] | None = None
