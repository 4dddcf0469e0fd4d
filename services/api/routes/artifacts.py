"""Content-addressed files, whole or by byte range, with caching that can never be wrong."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Request, Response
from fastapi.responses import StreamingResponse

from physworld_services.api.dependencies import StoresDep
from physworld_services.api.errors import documented
from physworld_services.api.ranges import digest_field, etag, parse_range, tag_matches
from physworld_storage.errors import NotFound

router = APIRouter(prefix="/artifacts", tags=["artifacts"])

MEDIA_TYPE = "application/octet-stream"
_FILE = {MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}
_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file", "content": _FILE},
    206: {"description": "A byte range of the file", "content": _FILE},
    304: {"description": "The client has this file"},
}

Sha256 = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$", description="SHA-256 of the file")]


@router.get(
    "/{sha256}", response_class=Response, responses={**_ANSWERS, **documented(401, 403, 404, 416, 422, 503)}
)
@router.head("/{sha256}", response_class=Response, include_in_schema=False)
def get_artifact(
    sha256: Sha256,
    request: Request,
    stores: StoresDep,
    if_none_match: Annotated[str | None, Header()] = None,
    if_range: Annotated[str | None, Header()] = None,
    byte_range: Annotated[str | None, Header(alias="Range")] = None,
) -> Response:
    """Stream a file. Files never change, so a client may keep one for ever."""
    if not stores.artifacts.exists(sha256):
        raise NotFound("artifact", sha256)
    size = stores.artifacts.size(sha256)
    headers = {
        "ETag": etag(sha256),
        "Cache-Control": "private, max-age=31536000, immutable",
        "Accept-Ranges": "bytes",
        "Repr-Digest": digest_field(sha256),
    }
    if tag_matches(if_none_match, sha256):
        return Response(status_code=304, headers=headers)
    if if_range is not None and not tag_matches(if_range, sha256):
        byte_range = None
    wanted = parse_range(byte_range, size) if request.method == "GET" else None
    start, end = wanted or (0, size)
    headers["Content-Length"] = str(end - start)
    headers["Content-Disposition"] = f'attachment; filename="{sha256}"'
    if wanted is None:
        headers["Content-Digest"] = digest_field(sha256)
    else:
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
    status = 200 if wanted is None else 206
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers, media_type=MEDIA_TYPE)
    return StreamingResponse(
        stores.artifacts.open(sha256, start, end), status, headers=headers, media_type=MEDIA_TYPE
    )
