"""Scenes on the wire: what is declared of a measured recording (the arrays travel as an archive)."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import Field

from schemas.base import Artifact, Resource


class Scene(Resource):
    """A measured scene as stored: immutable, addressed by the digest of its canonical bundle."""

    id: str
    name: str
    kind: str
    description: str = ""
    created_at: datetime
    digest: str
    frames: int
    points: int
    controllers: int
    fps: float
    duration_s: float
    noise_sigma_m: float | None = None
    train: tuple[int, int]
    test: tuple[int, int]
    declared: dict[str, Any] = Field(default_factory=dict)
    warnings: list[str] = Field(default_factory=list)
    artifacts: list[Artifact] = Field(default_factory=list)
    tags: list[str] = Field(default_factory=list)
