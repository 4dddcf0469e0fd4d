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

    episodes: int = Field(
        default=300, ge=1, le=20_000, description="How many episodes the twin demonstrates.", examples=[300]
    )
    frames: int | None = Field(
        default=None,
        ge=2,
        le=5000,
        description="Frames of an episode; empty: as many as the recording has.",
        examples=[100],
    )
    motion: Literal["vmp", "linear"] = Field(
        default="vmp",
        description="How grips move: curved paths at three-phase speed (vmp), or straight at constant speed.",
    )
    patterns: dict[Pattern, Annotated[float, Field(ge=0.0, le=1e6)]] | None = Field(
        default=None,
        description="Weights of the patterns of motion; empty: any direction alike.",
        examples=[{"lift": 1.0}],
    )
    replay_share: float = Field(
        default=0.2,
        ge=0.0,
        le=1.0,
        description="Share of episodes that replay the recording's own training motion.",
        json_schema_extra={"unit": "1"},
        examples=[0.2],
    )
    curvature_limit: float = Field(
        default=6.0,
        gt=0.0,
        le=100.0,
        description="Largest bend of a path, relative to its length.",
        json_schema_extra={"unit": "1"},
    )
    perturbation: Literal["p3", "uniform", "random", "none"] = Field(
        default="p3",
        description="How twins differ: fields over part features (p3), one factor, per particle, or not.",
    )
    properties: list[Property] = Field(
        default=["stiffness", "density"],
        max_length=3,
        description="Which properties differ between episodes.",
    )
    property_sigma: float = Field(
        default=0.2,
        ge=0.0,
        le=2.0,
        description="Standard deviation of the log of a property.",
        json_schema_extra={"unit": "1"},
        examples=[0.2],
    )
    length_scale: float = Field(
        default=1.0,
        gt=0.0,
        le=100.0,
        description="Length of the field's kernel over part features.",
        json_schema_extra={"unit": "1"},
    )
    space_scale: float | None = Field(
        default=None,
        gt=0.0,
        le=100.0,
        description="Length of the field's kernel in space; empty: features alone.",
        json_schema_extra={"unit": "object sizes"},
    )
    features: Literal["auto", "supplied", "geometric"] = Field(
        default="auto", description="Part features: from the recording, from the geometry, or what there is."
    )
    regrasp_share: float | None = Field(
        default=None,
        ge=0.0,
        le=1.0,
        description="Share of episodes in which one of several grips lets go for a while and takes hold again; empty: "
        "half of them where a grip of the recording lets go, else none.",
        json_schema_extra={"unit": "1"},
        examples=[0.5],
    )
    effects: Literal["perturbed", "as_found"] = Field(
        default="perturbed",
        description="Draw traced strengths within their intervals, or keep them as found.",
    )
    tries: int = Field(
        default=8, ge=1, le=100, description="Most tries of an episode before the dataset fails."
    )
    seed: Seed = Field(
        default=0,
        description="Seed of every random choice; the same seed gives the same result.",
        examples=[0],
    )

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

    fit_id: str = Field(
        description="Ready fit whose twin demonstrates.", examples=["fit_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    trace_id: str | None = Field(
        default=None, description="Ready trace of the fit's scene, whose effect the twin then carries."
    )
    config: DatasetConfig = Field(default_factory=DatasetConfig, description="Settings.")


class Episode(Resource):
    """One committed episode: its place in the store, digest of its arrays, seed and shape."""

    index: int = Field(description="Number of the episode, from 0.")
    path: str = Field(description="Place in the store.")
    digest: str = Field(description="SHA-256 of its arrays.")
    seed: int = Field(
        description="Seed of every random choice; the same seed gives the same result.", examples=[0]
    )
    frames: int = Field(description="Frames.")
    particles: int = Field(description="Particles.")
    attempt: int = Field(default=1, description="Attempt that was committed.")
    motion: str = Field(default="", description="Pattern of its motion.")


class Dataset(Resource):
    """Episodes under a manifest; immutable once ``sealed`` (``digest`` is the manifest's)."""

    id: str = Field(description="Identifier: a prefix of its kind and 26 characters that sort by time.")
    fit_id: str = Field(description="Fit whose twin is used.", examples=["fit_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    trace_id: str | None = Field(default=None, description="Trace whose effect the twin carries; null: none.")
    scene_id: str = Field(description="Scene that it is about.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    state: Literal["pending", "writing", "sealed", "failed", "cancelled"] = Field(
        description="`sealed` is ready and never changes again."
    )
    created_at: datetime = Field(description="When it was made, UTC.")
    job_id: str = Field(description="Job that makes it.", examples=["job_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    config: DatasetConfig = Field(description="Settings.")
    episodes_done: int = Field(default=0, description="Episodes that are written.")
    digest: str | None = Field(default=None, description="SHA-256 of the manifest; null until sealed.")
    statistics: dict[str, Any] = Field(default_factory=dict, description="Counts and times of the episodes.")
    lineage: Lineage = Field(
        default_factory=Lineage, description="What it was made from, by which code, with which seeds."
    )
    artifacts: list[Artifact] = Field(
        default_factory=list, description="Files, by name and SHA-256; download them from /v1/artifacts."
    )
