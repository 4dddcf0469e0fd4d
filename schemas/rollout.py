"""Rollouts: what a published model predicts for given control paths."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from physworld_schemas.arrays import MAX_LISTED_VALUES, ArrayInput, EncodedArray
from physworld_schemas.base import Artifact, Lineage, Request, Resource

MAX_CANDIDATES, MAX_TICKS = 4096, 3000
MAX_STEPS, MAX_VALUES = 500_000, 2**26
"""Of one request: candidates times ticks, and numbers in the answer (256 MiB)."""
SYNC_STEPS, SYNC_VALUES = 3000, 2**19
"""Up to these a rollout is answered at once (some seconds of one core, 2 MiB of numbers); beyond them it is a job."""
MAX_REQUEST_BYTES = 32 * 2**20
MAX_LOG_RATIO = 10.0
"""Largest logarithm of a ratio of properties; beyond, it means nothing."""

ModelName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$")]
VersionName = Annotated[str, Field(pattern=r"^([1-9][0-9]{0,8}|[a-z][a-z0-9_-]{0,31})$")]
Version = Annotated[int, Field(ge=1, lt=2**31)] | VersionName
Start = Literal["recording", "rest"]
Part = Literal["points", "vertices"]
Predictor = Literal["model", "twin"]
RunState = Literal["pending", "ready", "failed", "cancelled"]


class RolloutCreate(Request):
    """Body of POST /v1/rollouts.

    ``controllers`` are all control points [m], (B, T, K, 3), or (T, K, 3) for one candidate: at ticks of the model's
    clock, or at ``times`` [s], (T,) from 0, from which they are interpolated. With ``start`` "recording" the first
    h + 1 ticks belong to the model's history; with "rest" the body lies still where the recording begins until the
    second tick. ``dt_s``, where given, must be the model's. ``phi`` are log ratios of stiffness and
    density to the calibrated ones, (n, 2) or (B, n, 2), the fine-tuned ones without it; the factors come on top.
    ``by`` "twin": the calibrated twin that the version learned from is simulated instead of its network, always as a
    job; it has no ``phi``. Without ``by`` the version's ``predictor`` answers, and its network where there is ``phi``.
    """

    model: ModelName = Field(description="Name of the model.", examples=["soft_beam"])
    version: Version = Field(default="latest", description="Number, alias or `latest`.")
    controllers: ArrayInput = Field(
        description="Control paths, (B, T, K, 3) or (T, K, 3).", json_schema_extra={"unit": "m"}
    )
    times: list[float] | None = Field(
        default=None,
        max_length=MAX_LISTED_VALUES,
        description="Times of the paths, from 0; empty: ticks of the model's clock.",
        json_schema_extra={"unit": "s"},
    )
    dt_s: float | None = Field(
        default=None,
        gt=0,
        lt=10,
        description="Tick; where given it must be the model's.",
        json_schema_extra={"unit": "s"},
    )
    open_s: list[Annotated[list[tuple[float, float]], Field(max_length=1000)]] | None = Field(
        default=None,
        max_length=100,
        description="Of each grip of the scene, times at which it is open, [begin, end] from 0; others hold all "
        "the time. Needs a version of a recording in which grips let go.",
        json_schema_extra={"unit": "s"},
        examples=[[[], [[0.4, 0.7]]]],
    )
    start: Start = Field(default="recording", description="Begin as the recording did, or at rest.")
    phi: ArrayInput | None = Field(
        default=None,
        description="Log ratios of stiffness and density, (n, 2) or (B, n, 2).",
        json_schema_extra={"unit": "1"},
    )
    stiffness_factor: float = Field(
        default=1.0,
        ge=0.01,
        le=100,
        description="Stiffness relative to the calibrated one.",
        json_schema_extra={"unit": "1"},
        examples=[1.0],
    )
    density_factor: float = Field(
        default=1.0,
        ge=0.01,
        le=100,
        description="Density relative to the calibrated one.",
        json_schema_extra={"unit": "1"},
        examples=[1.0],
    )
    returns: list[Part] = Field(
        default=["points"],
        min_length=1,
        max_length=2,
        description="Measured points, vertices of the graph, or both.",
    )
    every: int = Field(
        default=1,
        ge=1,
        le=MAX_TICKS,
        description="Return every n-th tick.",
        json_schema_extra={"unit": "ticks"},
        examples=[1],
    )
    mode: Literal["auto", "job"] = Field(
        default="auto", description="Answer at once where it is small, or always as a job."
    )
    by: Predictor | None = Field(
        default=None,
        description="Who predicts: the version's network, or the calibrated twin that it learned from (a job); empty: "
        "the `predictor` of the version's metrics.",
    )

    @model_validator(mode="after")
    def _the_twin_has_no_phi(self) -> Self:
        if self.by == "twin" and self.phi is not None:
            raise ValueError(
                "phi is of the graph's vertices, which the twin has not: give stiffness_factor and density_factor"
            )
        return self


class Rollout(Resource):
    """Predicted places [m] at ``times`` [s] of the model's clock, 0 at its first tick.

    ``points`` (B, S, N, 3) are the scene's measured points, ``vertices`` (B, S, n, 3) the graph's. One that was
    answered at once has no ``id`` and is not kept; of a job the arrays lie in the artifact ``rollout.npz``.
    ``speed_m_s`` is the largest of any controller.
    """

    id: str | None = Field(default=None, description="Identifier; null where it was answered at once.")
    state: RunState = Field(default="ready", description="Whether the answer is there.")
    model: str = Field(description="Name of the model.", examples=["soft_beam"])
    version: int = Field(description="Version of the model.")
    by: Predictor = Field(
        default="model", description="Who predicted: the network, or the twin it learned from."
    )
    created_at: datetime | None = Field(default=None, description="When it was made, UTC.")
    job_id: str | None = Field(
        default=None, description="Job that makes it.", examples=["job_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    config: dict[str, Any] = Field(default_factory=dict, description="Settings.")
    dt_s: float | None = Field(
        default=None, description="Tick of the model's clock.", json_schema_extra={"unit": "s"}
    )
    history: int | None = Field(
        default=None, description="Ticks of history.", json_schema_extra={"unit": "ticks"}
    )
    candidates: int | None = Field(default=None, description="Control paths, B.")
    ticks: int | None = Field(default=None, description="Ticks of each, T.")
    times: list[float] = Field(
        default_factory=list, description="Times of the answer.", json_schema_extra={"unit": "s"}
    )
    points: EncodedArray | None = Field(
        default=None, description="Measured points, (B, S, N, 3).", json_schema_extra={"unit": "m"}
    )
    vertices: EncodedArray | None = Field(
        default=None, description="Vertices of the graph, (B, S, n, 3).", json_schema_extra={"unit": "m"}
    )
    speed_m_s: float | None = Field(
        default=None, description="Greatest speed of a controller.", json_schema_extra={"unit": "m/s"}
    )
    seconds: float | None = Field(
        default=None, description="Wall time that it took.", json_schema_extra={"unit": "s"}
    )
    sha256: str | None = Field(default=None, description="SHA-256 of the model's manifest.")
    lineage: Lineage = Field(
        default_factory=Lineage, description="What it was made from, by which code, with which seeds."
    )
    artifacts: list[Artifact] = Field(
        default_factory=list, description="Files, by name and SHA-256; download them from /v1/artifacts."
    )
