"""Upper bounds on request bodies, counted as they stream: 413 with both numbers, and nothing stored.

JSON is parsed in one call that holds the interpreter from the first value to the last, on the event loop or in any
other thread alike. So the values that a body lists are bounded too, by its commas; base64 has none.
"""

from __future__ import annotations

import re

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from physworld_schemas.arrays import MAX_LISTED_VALUES
from physworld_schemas.rollout import MAX_REQUEST_BYTES
from physworld_services.api.errors import ApiProblem, answer

JSON_LIMIT_BYTES = 1024 * 1024
MULTIPART_OVERHEAD_BYTES = 64 * 1024
UPLOAD_PATHS = frozenset(
    f"/{part}/{form}{preview}"
    for part in ("v1", "dashboard")
    for form in ("scenes", "trackings")
    for preview in ("", "/preview")
)
"""Of the API, and of the dashboard, whose forms bring the same files."""
PICTURE_PATH = re.compile(r"/(v1|dashboard)/scenes/[^/]+/pictures/[^/]+")
"""Of a splat, a camera or pictures beside a scene, for both."""
ARRAY_PATHS = frozenset({"/v1/rollouts"})


class BodyLimit:
    """ASGI middleware; uploads are bounded by the settings, rollouts by 32 MiB, every other body by 1 MiB.

    What is no upload lists at most ``MAX_LISTED_VALUES`` values.
    """

    def __init__(self, app: ASGIApp, max_upload_bytes: int) -> None:
        self.app = app
        self.max_upload_bytes = max_upload_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse by the declared length at once, and by the counted length while the body streams."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        uploads = scope["path"] in UPLOAD_PATHS or PICTURE_PATH.fullmatch(scope["path"]) is not None
        if uploads:
            allowed, limit = self.max_upload_bytes + MULTIPART_OVERHEAD_BYTES, self.max_upload_bytes
        elif scope["path"] in ARRAY_PATHS:
            allowed = limit = MAX_REQUEST_BYTES
        else:
            allowed = limit = JSON_LIMIT_BYTES
        declared = Headers(scope=scope).get("Content-Length", "0")
        if declared.isdigit() and int(declared) > allowed:
            await answer(too_large(int(declared), limit), scope)(scope, receive, send)
            return
        counted = listed = 0
        most_listed = None if uploads else MAX_LISTED_VALUES

        async def receive_counted() -> Message:
            nonlocal counted, listed
            message = await receive()
            counted += len(message.get("body", b""))
            if counted > allowed:
                raise too_large(counted, limit, at_least=True)
            if most_listed is not None:
                listed += message.get("body", b"").count(b",")
                if listed > most_listed:
                    raise too_long(listed, most_listed)
            return message

        await self.app(scope, receive_counted, send)


def too_large(size: int, limit: int, *, at_least: bool = False) -> ApiProblem:
    """The 413 with both numbers."""
    words = "at least " if at_least else ""
    return ApiProblem(
        413, "content_too_large", f"the body has {words}{size} bytes; the limit is {limit} bytes"
    )


def too_long(listed: int, most: int) -> ApiProblem:
    """The 413 for a body that lists too many values."""
    return ApiProblem(
        413,
        "content_too_large",
        f"the body lists more than {listed} values; the limit is {most}",
        hint='arrays may be given as {"shape", "dtype": "<f4", "data"} with base64 of little-endian float32',
    )
