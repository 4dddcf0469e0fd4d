"""Films: the file for the player of a page, and where the page of a film is."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import quote

from fastapi import APIRouter, Header
from fastapi.responses import RedirectResponse, Response, StreamingResponse

from physworld_schemas.video import FilmName, Video, VideoOf
from physworld_services.api.ranges import parse_range
from physworld_services.dashboard.site import BASE, Site
from physworld_storage import videos
from physworld_storage.errors import NotFound

SHOWN = 5
"""Films of one object that its page knows of."""


def router(site: Site) -> APIRouter:
    """Addresses below ``/videos``."""
    routes = APIRouter(prefix="/videos")

    @routes.get("/{video_id}")
    def one(video_id: str) -> Response:
        return RedirectResponse(f"{BASE}{page_of(_video(site, video_id))}#films", 303)

    @routes.get("/{video_id}/{name}")
    def film(
        video_id: str, name: FilmName, byte_range: Annotated[str | None, Header(alias="Range")] = None
    ) -> Response:
        """The film, or that of the recording, by byte range, which players need to seek; it never changes."""
        found = next((item for item in _video(site, video_id).artifacts if item.name == name), None)
        if found is None or not site.artifacts.exists(found.sha256):
            raise NotFound("film of video", video_id)
        wanted = parse_range(byte_range, found.size)
        start, end = wanted or (0, found.size)
        headers = {
            "Content-Length": str(end - start),
            "Accept-Ranges": "bytes",
            "Cache-Control": "private, max-age=31536000, immutable",
        }
        if wanted is not None:
            headers["Content-Range"] = f"bytes {start}-{end - 1}/{found.size}"
        content = site.artifacts.open(found.sha256, start, end)
        return StreamingResponse(
            content, 200 if wanted is None else 206, headers=headers, media_type="video/mp4"
        )

    return routes


def films_of(site: Site, *sources: tuple[VideoOf, str]) -> list[Video]:
    """The newest films of these objects, the newest first."""
    with site.database.reading() as session:
        found = [
            video
            for of, source_id in sources
            for video in videos.list_videos(session, of=of, source_id=source_id, limit=SHOWN).data
        ]
    return sorted(found, key=lambda video: video.created_at, reverse=True)


def page_of(video: Video) -> str:
    """Where the film is played, below the dashboard."""
    if video.of == "model":
        name, _, number = video.source_id.rpartition(":")
        return f"/models/{quote(name, safe='')}/{number}"
    if video.of == "rollout":
        return f"/rollouts/{video.source_id}"
    return f"/scenes/{video.scene_id}" + (f"?fit={video.source_id}" if video.of == "fit" else "")


def _video(site: Site, video_id: str) -> Video:
    with site.database.reading() as session:
        return videos.get_video(session, video_id)
