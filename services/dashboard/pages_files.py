"""Downloads of artifacts for people who are logged in; programs use the REST API, with ranges and keys."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import quote

from fastapi import APIRouter, Path, Query
from fastapi.responses import Response, StreamingResponse

from physworld_services.dashboard.site import Site
from physworld_storage.errors import NotFound


def router(site: Site) -> APIRouter:
    """Files below ``/artifacts``."""
    routes = APIRouter()

    @routes.get("/artifacts/{sha256}")
    def download(
        sha256: Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")],
        name: Annotated[str, Query(max_length=255)] = "",
    ) -> Response:
        if not site.artifacts.exists(sha256):
            raise NotFound("artifact", sha256)
        headers = {
            "Content-Length": str(site.artifacts.size(sha256)),
            "Content-Disposition": f"attachment; filename*=UTF-8''{quote(name or sha256, safe='')}",
            "Cache-Control": "private, max-age=31536000, immutable",
        }
        return StreamingResponse(
            site.artifacts.open(sha256), headers=headers, media_type="application/octet-stream"
        )

    return routes
