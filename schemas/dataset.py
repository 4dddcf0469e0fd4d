"""Datasets of demonstration episodes."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from physworld_schemas.base import Artifact, Lineage, Request, Resource, Seed

Pattern = Literal["single", "lift", "push", "stretch", "twist", "together", "bimanual", "hold_one"]
Property = Literal["stiffness", "density", "friction"]


class DatasetConfig(Request):
    """How many episodes, how they move, and what their twins differ in.

    ``motion``: ``vmp`` (curved paths at three-phase speed) or ``linear`` (straight lines at constant speed);
    ``patterns``: weights of the patterns, none given: motions in any direction alike, and none of the directed ones
    (lift, push, stretch, twist); ``replay_share`` of the episodes replay the recording's training frames.
    ``perturbation``: ``p3`` (a Gaussian field over part features), ``uniform`` (one factor for the whole body),
    ``random`` (each particle on its own) or ``none``, of the
    ``properties`` named, with ``property_sigma`` the standard deviation of the log of the stiffness; a kernel of
    features alone, or of space too (``space_scale``, in object sizes). ``effects``: whether strengths that a trace
    found are drawn within their intervals. An episode that is rejected is drawn anew, at most ``tries`` times.
    """

    episodes: int = Field(default=100, ge=1, le=20_000)
    frames: int | None = Field(default=None, ge=2, le=5000)
    motion: Literal["vmp", "linear"] = "vmp"
    patterns: dict[Pattern, Annotated[float, Field(ge=0.0, le=1e6)]] | None = None
    replay_share: float = Field(default=0.2, ge=0.0, le=1.0)
    curvature_limit: float = Field(default=6.0, gt=0.0, le=100.0)
    perturbation: Literal["p3", "uniform", "random", "none"] = "p3"
    properties: list[Property] = Field(default=["stiffness", "density"], max_length=3)
    property_sigma: float = Field(default=0.2, ge=0.0, le=2.0)
    length_scale: float = Field(default=1.0, gt=0.0, le=100.0)
    space_scale: float | None = Field(default=None, gt=0.0, le=100.0)
    features: Literal["auto", "supplied", "geometric"] = "auto"
    effects: Literal["perturbed", "as_found"] = "perturbed"
    tries: int = Field(default=8, ge=1, le=100)
    seed: Seed = 0

    @field_validator("patterns")
    @classmethod
    def _some_pattern(cls, patterns: dict[Pattern, float] | None) -> dict[Pattern, float] | None:
        if patterns is not None and not sum(patterns.values()) > 0.0:
            raise ValueError("at least one pattern needs a positive weight")
        return patterns

    @field_validator("properties")
    @classmethod
    def _each_once(cls, properties: list[Property]) -> list[Property]:
        if len(set(properties)) < len(properties):
            raise ValueError("names a property twice")
        return properties


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
