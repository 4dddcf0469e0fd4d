"""Scenes on the wire: what is declared of a measured recording (the arrays travel as an archive)."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from physworld_schemas.base import Artifact, Request, Resource, Tag

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
Unit = Literal["m", "cm", "mm", "in", "ft"]


class RecordingFacts(Request):
    """What a person knows of a recording, whatever its form."""

    name: str | None = Field(
        default=None,
        min_length=1,
        max_length=128,
        pattern=r"^[^/\\\x00-\x1f]+$",
        description="Name of the scene; empty: the file's.",
        examples=["my_beam"],
    )
    kind: str | None = Field(
        default=None,
        max_length=32,
        pattern=r"^[a-z_]+$",
        description="Kind of object.",
        examples=["soft_body"],
    )
    fps: float | None = Field(
        default=None,
        gt=0,
        le=1e5,
        allow_inf_nan=False,
        description="Frames per second.",
        json_schema_extra={"unit": "Hz"},
        examples=[30.0],
    )
    noise_sigma_m: float | None = Field(
        default=None,
        ge=0,
        le=1,
        allow_inf_nan=False,
        description="Standard deviation of the tracking noise per axis; null: not known.",
        json_schema_extra={"unit": "m"},
        examples=[0.001],
    )
    gravity_m_s2: tuple[float, float, float] | None = Field(
        default=None, description="Gravity.", json_schema_extra={"unit": "m/s²"}, examples=[[0.0, 0.0, -9.81]]
    )
    body: dict[str, Any] = Field(
        default_factory=dict, description="Keys of `scene.json`'s body.", examples=[{"density_kg_m3": 1000.0}]
    )
    up: Axis | None = Field(
        default=None, description="Axis of the recording that points up; null: guessed.", examples=["y"]
    )


class SceneImport(RecordingFacts):
    """What a foreign recording (tables of markers, PhysTwin) does not say of itself: ``options`` of POST /v1/scenes.

    What is left out is guessed where that can be done; ``POST /v1/scenes/preview`` says how. Bundles say everything
    themselves: of these they take ``name`` only.
    """

    controllers: tuple[str, ...] | None = Field(
        default=None,
        description="Markers, groups of them or rigid bodies that hold the object, * for any letters; `none`: nothing "
        "does; null: guessed.",
        examples=[["Gripper"]],
    )
    markers: tuple[str, ...] | None = Field(
        default=None,
        description="Likewise those on the object, in the order that the points shall have; null: all others.",
        examples=[["M1", "M2"]],
    )
    unit: Unit | None = Field(
        default=None, description="Unit of a table of markers; null: as it says, or guessed.", examples=["mm"]
    )
    importer: str | None = Field(
        default=None,
        max_length=32,
        pattern=r"^[a-z0-9_]+$",
        description="Form of the file, of `GET /v1/importers`; null: the content decides.",
        examples=["motive"],
    )
    assume: bool = Field(
        default=True,
        description="Whether facts of the body that nobody said stay open, with a warning; else such a table of "
        "markers is refused.",
    )


class ImportGuess(Resource):
    """What an import found without being told."""

    what: str = Field(description="What it is.", examples=["up"])
    value: str = Field(description="The value.", examples=["y"])
    how: str = Field(description="How it was found.", examples=["Motive's convention"])
    option: str = Field(description="Field of SceneImport that says otherwise.", examples=["up"])


class PreviewMarker(Resource):
    """A marker of a table, or a rigid body of which it has the pose alone."""

    name: str = Field(description="Its label in the file.", examples=["Hand:1"])
    roles: list[Literal["body", "gripper"]] = Field(
        description="What it would be taken for: either, both, or nothing.", examples=[["gripper"]]
    )
    rigid: bool = Field(
        default=False, description="Whether it is a rigid body's pose, which is never on the body."
    )
    place_m: tuple[float, float, float] = Field(
        description="Where it is in the scene's world, in the frame that shows most markers.",
        json_schema_extra={"unit": "m"},
        examples=[[0.1, 0.0, 1.2]],
    )


class ScenePreview(Resource):
    """What an import of a file would guess; nothing is stored."""

    importer: str = Field(description="Form of the file, for people.", examples=["OptiTrack Motive CSV"])
    guesses: list[ImportGuess] = Field(default_factory=list, description="What was found.")
    lines: list[str] = Field(
        default_factory=list, description="What is left out, what speaks against a guess."
    )
    markers: list[PreviewMarker] = Field(
        default_factory=list,
        description="All of a table of at most 2000, in the file's order, those on the body in their own.",
    )
    axes: list[tuple[float, float, float]] = Field(
        default_factory=list,
        description="Directions of the file's x, y and z in the scene's world; empty without markers.",
        examples=[[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]],
    )


class ScenePatch(Request):
    """Body of PATCH /v1/scenes/{scene_id}: the one field that is no part of the recording."""

    tags: list[Tag] = Field(
        max_length=50,
        description="Tags from now on, in the place of those before.",
        examples=[["soft", "day 2"]],
    )


class Scene(Resource):
    """A measured scene as stored, addressed by the digest of its canonical bundle: immutable but for its tags.

    ``declared`` is its ``scene.json``; a list leaves it out (null), since it may be long.
    """

    id: str = Field(description="Identifier: a prefix of its kind and 26 characters that sort by time.")
    name: str = Field(description="Name.")
    kind: str = Field(description="Kind of object.")
    description: str = Field(default="", description="Description for people.")
    created_at: datetime = Field(description="When it was made, UTC.")
    digest: str = Field(description="SHA-256 of the canonical archive: the same content is the same scene.")
    frames: int = Field(description="Frames.")
    points: int = Field(description="Measured points.")
    controllers: int = Field(description="Driven or clamped points.")
    fps: float = Field(description="Frames per second.", json_schema_extra={"unit": "Hz"})
    duration_s: float = Field(description="Length.", json_schema_extra={"unit": "s"})
    noise_sigma_m: float | None = Field(
        default=None,
        description="Standard deviation of the tracking noise per axis; null: not known.",
        json_schema_extra={"unit": "m"},
        examples=[0.001],
    )
    train: tuple[int, int] = Field(description="Frames for training: first and one past the last.")
    test: tuple[int, int] = Field(description="Held-out frames: first and one past the last.")
    declared: dict[str, Any] | None = Field(default=None, description="Its `scene.json`; null in lists.")
    warnings: list[str] = Field(default_factory=list, description="What the validator remarks.")
    artifacts: list[Artifact] = Field(
        default_factory=list, description="Files, by name and SHA-256; download them from /v1/artifacts."
    )
    tags: list[str] = Field(default_factory=list, description="Tags.")
