"""Rollouts: what a published model predicts for given control paths."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field

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
RunState = Literal["pending", "ready", "failed"]


class RolloutCreate(Request):
    """Body of POST /v1/rollouts.

    ``controllers`` are all control points [m], (B, T, K, 3), or (T, K, 3) for one candidate: at ticks of the model's
    clock, or at ``times`` [s], (T,) from 0, from which they are interpolated. With ``start`` "recording" the first
    h + 1 ticks belong to the model's history; with "rest" the body lies still where the recording begins until the
    second tick. ``dt_s``, where given, must be the model's. ``phi`` are log ratios of stiffness and
    density to the calibrated ones, (n, 2) or (B, n, 2), the fine-tuned ones without it; the factors come on top.
    """

    model: ModelName
    version: Version = "latest"
    controllers: ArrayInput
    times: list[float] | None = Field(default=None, max_length=MAX_LISTED_VALUES)
    dt_s: float | None = Field(default=None, gt=0, lt=10)
    start: Start = "recording"
    phi: ArrayInput | None = None
    stiffness_factor: float = Field(default=1.0, ge=0.01, le=100)
    density_factor: float = Field(default=1.0, ge=0.01, le=100)
    returns: list[Part] = Field(default=["points"], min_length=1, max_length=2)
    every: int = Field(default=1, ge=1, le=MAX_TICKS)
    mode: Literal["auto", "job"] = "auto"


class Rollout(Resource):
    """Predicted places [m] at ``times`` [s] of the model's clock, 0 at its first tick.

    ``points`` (B, S, N, 3) are the scene's measured points, ``vertices`` (B, S, n, 3) the graph's. One that was
    answered at once has no ``id`` and is not kept; of a job the arrays lie in the artifact ``rollout.npz``.
    ``speed_m_s`` is the largest of any controller.
    """

    id: str | None = None
    state: RunState = "ready"
    model: str
    version: int
    created_at: datetime | None = None
    job_id: str | None = None
    config: dict[str, Any] = Field(default_factory=dict)
    dt_s: float | None = None
    history: int | None = None
    candidates: int | None = None
    ticks: int | None = None
    times: list[float] = Field(default_factory=list)
    points: EncodedArray | None = None
    vertices: EncodedArray | None = None
    speed_m_s: float | None = None
    seconds: float | None = None
    sha256: str | None = None
    lineage: Lineage = Field(default_factory=Lineage)
    artifacts: list[Artifact] = Field(default_factory=list)
