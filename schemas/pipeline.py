"""The whole chain in one call: fit, dataset, training."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from schemas.base import Request, Resource
from schemas.dataset import DatasetConfig
from schemas.fit import FitConfig
from schemas.model import TrainingConfig


class PipelineCreate(Request):
    """Body of POST /v1/pipelines. ``model_name`` null takes the scene's name."""

    scene_id: str
    model_name: str | None = Field(default=None, pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$")
    fit: FitConfig = Field(default_factory=FitConfig)
    dataset: DatasetConfig = Field(default_factory=DatasetConfig)
    training: TrainingConfig = Field(default_factory=TrainingConfig)


class ModelReference(Resource):
    """Which model a report speaks of."""

    name: str
    version: int
    sha256: str


class RunReport(Resource):
    """The figures of one main job, under stable keys (``physworld run --json``).

    ``held_out`` maps a metric (``track_m``, ``chamfer_phystwin_m``, ``chamfer_l2_m``, all in metres) to the
    figures of ``static``, ``rigid_follow``, ``constant_velocity``, ``twin``, ``world_model`` and
    ``world_model_finetuned``.
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
