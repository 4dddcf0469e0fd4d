"""Trackings on the wire: pictures of an object in motion that a job makes a scene of."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from physworld_schemas.base import Request, Resource
from physworld_schemas.scene import RecordingFacts

MOST_CAMERAS, MOST_SIDE_PX, FARTHEST_M = 16, 16_384, 100.0
PX: dict[str, Any] = {"unit": "px"}
METRES: dict[str, Any] = {"unit": "m"}

CameraNumber = Annotated[int, Field(ge=0, lt=MOST_CAMERAS)]
Pixel = Annotated[int, Field(ge=-MOST_SIDE_PX, le=MOST_SIDE_PX)]
PixelBox = tuple[Pixel, Pixel, Pixel, Pixel]
"""Left, top, right, bottom of a box in a first picture; the last two are outside of it."""
Place = Annotated[float, Field(ge=-MOST_SIDE_PX, le=MOST_SIDE_PX, allow_inf_nan=False)]
Line = tuple[Place, Place, Place, Place]
"""Column and row of two pixels."""
Length = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]
Corner = tuple[Length, Length, Length]
Share = Annotated[float, Field(ge=-1, le=1, allow_inf_nan=False)]
Pose = tuple[Length, Length, Length, Share, Share, Share, Share]
"""Place [m] and quaternion, scalar first."""
FileName = Annotated[str, Field(min_length=1, max_length=1024, pattern=r"^[^\x00-\x1f\\]+$")]
"""Path of a file in the archive."""


class Gripper(Request):
    """What tells the gripper's motion, one of ``marker``, ``patch``, ``colour`` and ``log``; and what it holds."""

    marker: int | None = Field(
        default=None,
        ge=-1,
        le=100_000,
        description="Number of an ArUco or AprilTag marker on it; -1: the first that is seen.",
        examples=[7],
    )
    dictionary: str = Field(
        default="4X4_50", max_length=32, pattern=r"^[A-Za-z0-9_]+$", description="Of the marker."
    )
    patch: PixelBox | None = Field(
        default=None,
        description="A box on it in the first camera's first picture, whose texture is followed.",
        json_schema_extra=PX,
        examples=[[200, 60, 250, 90]],
    )
    colour: tuple[Pixel, Pixel] | None = Field(
        default=None,
        description="Column and row of a pixel of its colour there; such a gripper does not turn.",
        json_schema_extra=PX,
        examples=[[225, 75]],
    )
    log: FileName | None = Field(
        default=None,
        description="A robot's log in the archive: CSV with `t,x,y,z` and, if it turns, "
        "`qw,qx,qy,qz`; MCAP; or a parquet file of LeRobot with `info.json`, or the folder of its data set.",
        examples=["robot.csv"],
    )
    log_pose: str | None = Field(
        default=None,
        min_length=1,
        max_length=256,
        description="Which of several poses: a topic of MCAP, `/tf:FRAME`, or what stands before x, y and z in "
        "names of LeRobot; null: the only one.",
        examples=["/tool/pose"],
    )
    log_episode: int | None = Field(
        default=None,
        ge=0,
        lt=10**9,
        description="Which of several episodes of LeRobot; null: the only one.",
        examples=[3],
    )
    log_delay_s: float = Field(
        default=0.0,
        ge=-3600,
        le=3600,
        allow_inf_nan=False,
        description="Of the pictures' clock behind the log's.",
        json_schema_extra={"unit": "s"},
    )
    log_base: Pose | None = Field(
        default=None,
        description="Pose of the log's frame (the robot's base) in the cameras' world, from a hand-eye calibration: "
        "x, y, z in metres and a quaternion, scalar first; null: the log is in the scene's world.",
        examples=[[0.4, 0.0, -0.1, 1.0, 0.0, 0.0, 0.0]],
    )
    held_px: PixelBox | None = Field(
        default=None,
        description="A box around what it holds of the object, in the same picture.",
        json_schema_extra=PX,
        examples=[[205, 85, 245, 110]],
    )
    held_m: tuple[Corner, Corner] | None = Field(
        default=None,
        description="Instead, two corners of a box of undeformed material, in the scene's world.",
        json_schema_extra=METRES,
        examples=[[[-0.02, -0.02, 0.28], [0.02, 0.02, 0.32]]],
    )

    @model_validator(mode="after")
    def _one_tells(self) -> Self:
        told = [name for name in ("marker", "patch", "colour", "log") if getattr(self, name) is not None]
        if len(told) != 1:
            raise ValueError(
                f"one of marker, patch, colour and log is needed, got {', '.join(told) or 'none'}"
            )
        return self


class FilmPlane(Request):
    """Where the plane of a film lies: a printed ``board`` in it, or two of its ``pixels`` and ``length_m`` between."""

    board: str | None = Field(
        default=None,
        max_length=128,
        pattern=r"^(charuco|aruco|marker):[0-9A-Za-z_.:-]+$",
        description="`charuco:COLUMNSxROWS:SQUARE:MARKER`, `aruco:COLUMNSxROWS:MARKER:GAP` or `marker:NUMBER:SIDE`, in "
        "metres; behind it a dictionary if it is not `4X4_50`.",
        examples=["charuco:7x5:0.04:0.03"],
    )
    pixels: Line | None = Field(
        default=None,
        description="Column and row of two pixels of the first picture.",
        json_schema_extra=PX,
        examples=[[400.0, 300.0, 900.0, 310.0]],
    )
    length_m: float | None = Field(
        default=None,
        gt=0,
        le=FARTHEST_M,
        allow_inf_nan=False,
        description="Between them.",
        json_schema_extra=METRES,
        examples=[0.5],
    )
    lens: FileName | None = Field(
        default=None,
        description="Camera, JSON in the archive: `width`, `height`, `fx`, `fy`, `cx`, `cy`, perhaps `distortion`.",
        examples=["camera.json"],
    )
    plumb: Line | None = Field(
        default=None,
        description="Two pixels of a line in the plane along which gravity pulls; null: `up`.",
        json_schema_extra=PX,
        examples=[[300.0, 100.0, 302.0, 400.0]],
    )
    before_m: float = Field(
        default=0.0,
        ge=-10,
        le=10,
        allow_inf_nan=False,
        description="How far the object moves before the plane, towards the camera.",
        json_schema_extra=METRES,
    )

    @model_validator(mode="after")
    def _one_tells(self) -> Self:
        if (self.board is None) == (self.pixels is None or self.length_m is None):
            raise ValueError("either board is needed, or pixels and length_m")
        return self


class TrackingOptions(RecordingFacts):
    """What a person says of pictures: ``options`` of POST /v1/trackings. A film of one camera needs ``plane``."""

    boxes: dict[CameraNumber, PixelBox] = Field(
        default_factory=dict,
        description="By the camera's number: left, top, right, bottom of a box around the object in its first picture.",
        json_schema_extra=PX,
        examples=[{"0": [211, 208, 470, 273]}],
    )
    masks: dict[CameraNumber, FileName] = Field(
        default_factory=dict,
        description="Instead, PNG files in the archive, white on the object.",
        examples=[{"0": "mask.png"}],
    )
    tracks: dict[CameraNumber, FileName] = Field(
        default_factory=dict,
        description="Tracks of another tracker, npz files in the archive; `tracks/CAMERA.npz` needs no name.",
        examples=[{"0": "cotracker.npz"}],
    )
    gripper: Gripper | None = Field(default=None, description="What moves the object; null: nothing grips.")
    plane: FilmPlane | None = Field(
        default=None, description="Of a film of a motion in a plane; null: pictures with depth."
    )
    depth_scale: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        allow_inf_nan=False,
        description="Depth values a metre; null: 1000 of whole numbers, 1 of others.",
        json_schema_extra={"unit": "1/m"},
        examples=[1000.0],
    )
    first: int = Field(default=0, ge=0, lt=10**6, description="First frame that is read.")
    last: int | None = Field(
        default=None,
        ge=1,
        lt=10**6,
        description="Frame after the last that is read; null: all.",
        examples=[90],
    )
    points: int | None = Field(
        default=None,
        ge=8,
        le=20_000,
        description="To follow in each camera; null: as many as the importer takes.",
        examples=[250],
    )
    undeformed: bool = Field(
        default=False, description="Whether the first frame shows the object undeformed and at rest."
    )
    keep_pictures: bool = Field(
        default=False, description="Keep the first camera and its pictures beside the scene, for films."
    )
    fit_splat: bool = Field(
        default=False,
        description="Fit a splat to the first pictures, which films of the scene then draw: of pictures with depth; "
        "takes a minute or more.",
    )


class FirstPicture(Resource):
    """What a camera shows first."""

    camera: int = Field(description="Its number.", examples=[0])
    name: str = Field(description="Of its folder or film.", examples=["0"])
    frames: int = Field(description="Pictures of it; 0: not known before the film is read.", examples=[90])
    media_type: Literal["image/png", "image/jpeg"] | None = Field(
        default=None, description="Of `data`; null: it cannot be shown here.", examples=["image/png"]
    )
    data: str = Field(default="", description="The picture, base64.", examples=["iVBORw0KGgo="])


class FirstCloud(Resource):
    """What pictures with depth show first: every n-th pixel that has depth, in the world of the scene to be."""

    places_m: list[tuple[float, float, float]] = Field(
        description="At most 5000 places, z up.", json_schema_extra=METRES, examples=[[[0.012, 0.48, 0.11]]]
    )
    colours: list[tuple[int, int, int]] = Field(
        description="Of each: red, green, blue, of 255.", examples=[[[130, 91, 52]]]
    )
    cameras: list[int] = Field(description="Number of the camera that saw each.", examples=[[0]])
    pixels: list[tuple[int, int]] = Field(
        description="Column and row of each in the first picture of its camera.",
        json_schema_extra=PX,
        examples=[[[64, 48]]],
    )
    ground_m: float | None = Field(
        description="Height of the ground; null: none is seen.", json_schema_extra=METRES, examples=[0.0]
    )
    up: str = Field(
        description="How up was found.", examples=["the normal of the ground in the first picture"]
    )
    warnings: list[str] = Field(description="What was guessed.", examples=[["no ground is seen"]])


class TrackingPreview(Resource):
    """What an archive of pictures or a film holds; nothing is stored."""

    form: Literal["rgbd", "film"] = Field(
        description="Pictures with depth, or a film of a motion in a plane.", examples=["rgbd"]
    )
    cameras: list[FirstPicture] = Field(description="The first picture of each camera.")
    cloud: FirstCloud | None = Field(
        default=None, description="Of pictures with depth; null: there is none, or `unclouded` says why not."
    )
    unclouded: str | None = Field(
        default=None,
        description="What keeps the depth of the first pictures from being shown.",
        examples=["cameras: holds no calibration"],
    )
