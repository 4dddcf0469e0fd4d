"""The calls about films and about the pictures beside a scene; shared by both clients."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

from pydantic import TypeAdapter

from physworld_client.bundle import Upload, open_file
from physworld_client.calls import Call
from physworld_client.errors import BundleUnreadable
from physworld_client.types import Job, Scene, Video
from physworld_schemas.base import Page
from physworld_schemas.video import PictureName, VideoConfig, VideoCreate, VideoOf

_JOB, _SCENE, _VIDEO = TypeAdapter(Job), TypeAdapter(Scene), TypeAdapter(Video)
_VIDEOS = TypeAdapter(Page[Video])
BY_SUFFIX: dict[str, PictureName] = {".ply": "splat.ply", ".json": "camera.json", ".npz": "frames.npz"}
"""What a file of pictures is, by its ending."""


def create(of: VideoOf, id: str, config: VideoConfig | None) -> Call[Job]:
    """POST /v1/videos."""
    return Call("POST", "/v1/videos", _JOB, body=VideoCreate(of=of, id=id, config=config or VideoConfig()))


def get(video_id: str) -> Call[Video]:
    """GET /v1/videos/{id}."""
    return Call("GET", f"/v1/videos/{quote(video_id, safe='')}", _VIDEO)


def listed(
    *,
    limit: int | None,
    cursor: str | None,
    scene_id: str | None,
    of: VideoOf | None,
    source_id: str | None,
) -> Call[Page[Video]]:
    """GET /v1/videos.

    Args:
        limit: most films of a page; None leaves it to the service.
        cursor: of the page before.
        scene_id: only films that belong to this scene.
        of: only films of this kind of object.
        source_id: only films of this object.
    """
    asked = {"limit": limit, "cursor": cursor, "scene_id": scene_id, "of": of, "source_id": source_id}
    query = {name: value for name, value in asked.items() if value is not None}
    return Call("GET", "/v1/videos", _VIDEOS, query=query)


def put_picture(scene_id: str, name: PictureName, upload: Upload) -> Call[Scene]:
    """POST /v1/scenes/{id}/pictures/{name}, multipart field ``bundle``."""
    return Call("POST", f"/v1/scenes/{quote(scene_id, safe='')}/pictures/{name}", _SCENE, upload=upload)


def picture_at(path: str | Path) -> tuple[PictureName, Upload]:
    """What the file is, by its ending, and the open file. Raises BundleUnreadable."""
    suffix = Path(path).suffix.lower()
    if suffix not in BY_SUFFIX:
        known = ", ".join(f"{ending} ({name})" for ending, name in BY_SUFFIX.items())
        raise BundleUnreadable(f"{path} ends in {suffix!r}; the pictures of a scene are {known}")
    return BY_SUFFIX[suffix], open_file(path)
