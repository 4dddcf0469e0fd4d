"""Scenes on the wire: what is declared of a measured recording (the arrays travel as an archive)."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from physworld_schemas.base import Artifact, Request, Resource

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


class SceneImport(Request):
    """What a foreign recording (C3D, PhysTwin) does not say of itself: ``options`` of POST /v1/scenes.

    ``body`` holds keys of ``scene.json``'s ``body``; ``controllers`` the labels of C3D's driven or clamped
    markers; ``up`` the axis of the recording that points up. Bundles say everything themselves: of these they
    take ``name`` only.
    """

    name: str | None = Field(default=None, min_length=1, max_length=128, pattern=r"^[^/\\\x00-\x1f]+$")
    kind: str | None = Field(default=None, max_length=32, pattern=r"^[a-z_]+$")
    fps: float | None = Field(default=None, gt=0, le=1e5, allow_inf_nan=False)
    noise_sigma_m: float | None = Field(default=None, ge=0, le=1, allow_inf_nan=False)
    gravity_m_s2: tuple[float, float, float] | None = None
    body: dict[str, Any] = Field(default_factory=dict)
    controllers: tuple[str, ...] | None = None
    up: Axis = "z"


class Scene(Resource):
    """A measured scene as stored: immutable, addressed by the digest of its canonical bundle.

    ``declared`` is its ``scene.json``; a list leaves it out (null), since it may be long.
    """

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
    declared: dict[str, Any] | None = None
    warnings: list[str] = Field(default_factory=list)
    artifacts: list[Artifact] = Field(default_factory=list)
    tags: list[str] = Field(default_factory=list)
