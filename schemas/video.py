"""Films: a recording, a twin, a model's prediction or a rollout through a camera, drawn by a job."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field

from physworld_schemas.base import RATIO, Artifact, Lineage, Request, Resource
from physworld_schemas.rollout import MAX_CANDIDATES

VideoOf = Literal["scene", "fit", "model", "rollout"]
VideoState = Literal["pending", "ready", "failed", "cancelled"]
PictureName = Literal["splat.ply", "camera.json", "frames.npz"]
FilmName = Literal["film.mp4", "recording.mp4"]
FILM: FilmName = "film.mp4"
RECORDING: FilmName = "recording.mp4"
"""The scene's own pictures as a film of the same frames and size, where the film is compared with them."""
MOST_SIDE_PX, LEAST_SIDE_PX = 1920, 16
MOST_FRAMES = 3000
MAX_CAMERA_BYTES = 16 * 1024

Side = Annotated[int, Field(ge=LEAST_SIDE_PX, le=MOST_SIDE_PX, json_schema_extra={"unit": "px"})]
Number = Annotated[float, Field(allow_inf_nan=False)]


class CameraView(Request):
    """A pinhole camera in the convention of OpenCV: x right, y down, z forward."""

    width: Side = Field(description="Width of the picture.", examples=[640])
    height: Side = Field(description="Height of the picture.", examples=[480])
    fx: Number = Field(gt=0, description="Focal length along x.", json_schema_extra={"unit": "px"})
    fy: Number = Field(gt=0, description="Focal length along y.", json_schema_extra={"unit": "px"})
    cx: Number = Field(description="Principal point along x.", json_schema_extra={"unit": "px"})
    cy: Number = Field(description="Principal point along y.", json_schema_extra={"unit": "px"})
    world_to_camera: Annotated[
        list[Annotated[list[Number], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)
    ] = Field(description="Rigid transform from the scene's world to the camera, (4, 4), lengths in metres.")


class VideoConfig(Request):
    """Settings of a film.

    ``camera`` counts first; with ``view`` "auto" the scene's own camera is taken next, where it has one, and else one
    that sees the whole motion from ``azimuth_deg`` and ``elevation_deg``, as ``view`` "whole" always does.
    """

    camera: CameraView | None = Field(default=None, description="Camera; empty: as `view` says.")
    view: Literal["auto", "whole"] = Field(
        default="auto", description="The scene's own camera where it has one, or the whole motion in view."
    )
    azimuth_deg: float = Field(
        default=-60.0,
        ge=-360.0,
        le=360.0,
        description="Of a view of the whole motion, around the vertical.",
        json_schema_extra={"unit": "deg"},
    )
    elevation_deg: float = Field(
        default=20.0,
        ge=-89.0,
        le=89.0,
        description="Of a view of the whole motion, above the ground.",
        json_schema_extra={"unit": "deg"},
    )
    width: Side = Field(default=640, description="Width of a view of the whole motion.")
    height: Side = Field(default=480, description="Height of a view of the whole motion.")
    look: Literal["auto", "points", "fitted"] = Field(
        default="auto",
        description="The scene's splat where it has one, or spheres at the points; or a splat that is fitted to the "
        "first of the scene's pictures, within their masks, and kept beside the film.",
    )
    candidate: int = Field(
        default=0, ge=0, lt=MAX_CANDIDATES, description="Of a rollout: which of its control paths."
    )


class VideoCreate(Request):
    """Body of POST /v1/videos."""

    of: VideoOf = Field(
        description="A scene's recording, a fit's twin, a model's prediction of its recording, or a rollout."
    )
    id: str = Field(
        pattern=r"^[A-Za-z0-9_.:-]{1,128}$",
        description="Its identifier; of a model `name:version`, also with an alias.",
        examples=["fit_01JZ8Q5V3M7X2K9T4B6N8R0C1D"],
    )
    config: VideoConfig = Field(default_factory=VideoConfig, description="Settings.")


class VideoScores(Resource):
    """The film against the scene's pictures; lists have one number a frame."""

    psnr_db: float | None = Field(
        description="Mean over the frames that are not equal.", json_schema_extra={"unit": "dB"}
    )
    ssim: float = Field(description="Mean over the frames.", json_schema_extra=RATIO)
    iou: float | None = Field(
        default=None, description="Mean over the frames; null: no masks.", json_schema_extra=RATIO
    )
    psnr_db_per_frame: list[float | None] = Field(
        description="Null where both pictures are equal.", json_schema_extra={"unit": "dB"}
    )
    ssim_per_frame: list[float] = Field(
        description="1 where both pictures are equal.", json_schema_extra=RATIO
    )
    iou_per_frame: list[float] | None = Field(
        default=None, description="Null: no masks.", json_schema_extra=RATIO
    )
    lpips: float | None = Field(
        default=None,
        description="Mean over the frames, by AlexNet; null: the worker has no weights of LPIPS, or a side of "
        "the film is less than 31 px.",
        json_schema_extra=RATIO,
    )
    lpips_per_frame: list[float] | None = Field(
        default=None,
        description="0 where both pictures are equal; null: not measured.",
        json_schema_extra=RATIO,
    )


class VideoReport(Resource):
    """What was drawn."""

    frames: int = Field(description="Frames of the film.")
    fps: float = Field(description="Its rate, that of the motion.", json_schema_extra={"unit": "Hz"})
    drawn: Literal["splat", "points", "fitted"] = Field(description="What was drawn.")
    gaussians: int = Field(description="How many Gaussians or spheres.")
    seen_from: Literal["given", "scene", "whole"] = Field(description="Whose camera it was.")
    camera: CameraView = Field(description="The camera.")
    scores: VideoScores | None = Field(default=None, description="Against the scene's pictures.")
    not_scored: str = Field(default="", description="Why there are no scores.")
    seconds: float = Field(description="Wall time that it took.", json_schema_extra={"unit": "s"})


class Video(Resource):
    """A film of a motion; ``report`` and the artifact ``film.mp4`` are there once it is ready.

    Where it is compared with the scene's pictures, ``recording.mp4`` shows these, frame by frame at the same times.
    """

    id: str = Field(description="Identifier: a prefix of its kind and 26 characters that sort by time.")
    of: VideoOf = Field(description="What moves in it.")
    source_id: str = Field(description="Identifier of that; of a model `name:version`.")
    scene_id: str = Field(
        description="Scene that it belongs to.", examples=["scn_01JZ8Q5V3M7X2K9T4B6N8R0C1D"]
    )
    state: VideoState = Field(description="Whether the film is there.")
    created_at: datetime = Field(description="When it was asked for, UTC.")
    job_id: str = Field(description="Job that makes it.", examples=["job_01JZ8Q5V3M7X2K9T4B6N8R0C1D"])
    config: VideoConfig = Field(description="Settings.")
    report: VideoReport | None = Field(default=None, description="What was drawn; null until ready.")
    lineage: Lineage = Field(
        default_factory=Lineage, description="What it was made from, by which code, with which seeds."
    )
    artifacts: list[Artifact] = Field(
        default_factory=list,
        description="Files, by name and SHA-256; download them from /v1/artifacts: `film.mp4`, with scores "
        '`recording.mp4`, and with `look` "fitted" `splat.ply`.',
    )
