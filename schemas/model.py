"""World models: a name, integer versions that only grow, aliases that move."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from schemas.base import Artifact, Lineage, Request, Resource, Seed


class TrainingConfig(Request):
    """Settings of the graph network (paper, section GNN-Based World Models) and of its training.

    The defaults are meant for some minutes on one core; look-ahead grows to its value during training.
    """

    hidden: int = Field(default=64, ge=8, le=1024)
    message_passing_steps: int = Field(default=7, ge=1, le=20)
    history: int = Field(default=3, ge=1, le=10)
    look_ahead: int = Field(default=24, ge=1, le=200)
    vertices: int = Field(default=100, ge=4, le=1000)
    steps: int = Field(default=240, ge=1, le=1_000_000)
    batch_size: int = Field(default=6, ge=1, le=256)
    learning_rate: float = Field(default=1e-3, gt=0, le=1)
    fine_tune_steps: int = Field(default=60, ge=0, le=10_000)
    seed: Seed = 0


class TrainingCreate(Request):
    """Body of POST /v1/models: trains on a sealed dataset and publishes the next version of ``name``."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$")
    dataset_id: str
    config: TrainingConfig = Field(default_factory=TrainingConfig)
    description: str = ""
    tags: list[str] = Field(default_factory=list)


class ModelVersion(Resource):
    """A published version; immutable once ready. ``sha256`` is the digest of its manifest."""

    name: str
    version: int
    state: Literal["pending", "ready", "failed"]
    message: str = ""
    created_at: datetime
    job_id: str | None = None
    scene_id: str | None = None
    fit_id: str | None = None
    trace_id: str | None = None
    dataset_id: str | None = None
    description: str = ""
    tags: list[str] = Field(default_factory=list)
    aliases: list[str] = Field(default_factory=list)
    config: TrainingConfig = Field(default_factory=TrainingConfig)
    metrics: dict[str, Any] = Field(default_factory=dict)
    sha256: str | None = None
    lineage: Lineage = Field(default_factory=Lineage)
    artifacts: list[Artifact] = Field(default_factory=list)


class Model(Resource):
    """A registered name with its newest version and aliases."""

    name: str
    created_at: datetime
    latest_version: int | None = None
    aliases: dict[str, int] = Field(default_factory=dict)


class AliasSet(Request):
    """Body of PUT /v1/models/{name}/aliases/{alias}."""

    version: int = Field(ge=1, lt=2**31)
