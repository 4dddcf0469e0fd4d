"""Datasets of demonstration episodes."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from schemas.base import Artifact, Lineage, Request, Resource, Seed


class DatasetConfig(Request):
    """How many episodes, and how strongly the calibrated properties are perturbed (log-space sigma)."""

    episodes: int = Field(default=100, ge=1, le=20_000)
    frames: int | None = Field(default=None, ge=2, le=5000)
    property_sigma: float = Field(default=0.2, ge=0.0, le=2.0)
    seed: Seed = 0


class DatasetCreate(Request):
    """Body of POST /v1/datasets.

    ``trace_id`` names a ready trace of the fit's scene: where it named an effect, its twin demonstrates.
    """

    fit_id: str
    trace_id: str | None = None
    config: DatasetConfig = Field(default_factory=DatasetConfig)


class Episode(Resource):
    """One committed episode: its place in the store, digest of its arrays, seed and shape."""

    index: int
    path: str
    digest: str
    seed: int
    frames: int
    particles: int
    attempt: int = 1
    motion: str = ""


class Dataset(Resource):
    """Episodes under a manifest; immutable once ``sealed`` (``digest`` is the manifest's)."""

    id: str
    fit_id: str
    trace_id: str | None = None
    scene_id: str
    state: Literal["pending", "writing", "sealed", "failed"]
    created_at: datetime
    job_id: str
    config: DatasetConfig
    episodes_done: int = 0
    digest: str | None = None
    statistics: dict[str, Any] = Field(default_factory=dict)
    lineage: Lineage = Field(default_factory=Lineage)
    artifacts: list[Artifact] = Field(default_factory=list)
