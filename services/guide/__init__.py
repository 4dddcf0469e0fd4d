"""The guide at ``/docs/guide``: the pages that ``make docs`` builds from ``docs/`` into ``site/`` beside this file.

``make up`` builds it too, and a wheel carries what was built before it was made (``make wheels`` builds both). Where
nothing was built the address answers 404 and says what to do, and the dashboard has no link to it. Pages need no key:
they are the documentation, the same for everybody.
"""

from __future__ import annotations

import base64
import hashlib
import re
from functools import lru_cache
from pathlib import Path

from fastapi import FastAPI
from fastapi.responses import PlainTextResponse, RedirectResponse, Response
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.staticfiles import StaticFiles
from starlette.types import Message, Receive, Scope, Send

BASE = "/docs/guide"
SITE = Path(__file__).parent / "site"
NOT_BUILT = (
    "The guide is not built in this installation. In a checkout run `make docs` and load this page again; "
    "a wheel holds the guide if it was made by `make wheels`. The sources of all pages are in docs/.\n"
)
INLINE_SCRIPT = re.compile(rb"<script>(.*?)</script>", re.DOTALL)


def is_built(site: Path | None = None) -> bool:
    """Whether there is a guide to serve; what links to it asks first."""
    return ((site or SITE) / "index.html").is_file()


def mount(app: FastAPI, site: Path = SITE) -> None:
    """Add the guide to the web process. What is built later is served without a restart."""

    @app.get(BASE, include_in_schema=False)
    def without_slash() -> RedirectResponse:
        return RedirectResponse(f"{BASE}/", 307)

    app.mount(BASE, Guide(site), name="guide")


class Guide:
    """ASGI application: the files of a built site, each with the policy that it needs."""

    def __init__(self, site: Path) -> None:
        self._site = site
        self._files = StaticFiles(directory=site, html=True, check_dir=False)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""

        async def with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["Content-Security-Policy"] = self._policy(scope)
                headers["X-Content-Type-Options"] = "nosniff"
                headers["Referrer-Policy"] = "same-origin"
                headers["Cache-Control"] = "no-cache"
            await send(message)

        await (await self._answer(scope))(scope, receive, with_policy)

    async def _answer(self, scope: Scope) -> Response:
        if not is_built(self._site):
            return PlainTextResponse(NOT_BUILT, 404)
        try:
            return await self._files.get_response(self._files.get_path(scope), scope)
        except HTTPException as problem:
            return PlainTextResponse(f"{problem.detail}\n", problem.status_code)

    def _policy(self, scope: Scope) -> str:
        """Everything from this server alone; inline scripts only as they stand in the built page."""
        page = self._site / self._files.get_path(scope)
        page = page / "index.html" if page.is_dir() else page
        scripts = ""
        if page.suffix == ".html" and page.is_file():
            scripts = "".join(f" '{digest}'" for digest in _digests(page, page.stat().st_mtime_ns))
        return (
            f"default-src 'none'; script-src 'self'{scripts}; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
            "media-src 'self'; font-src 'self'; connect-src 'self'; worker-src 'self'; base-uri 'none'; "
            "form-action 'self'; frame-ancestors 'none'"
        )


@lru_cache(maxsize=256)
def _digests(page: Path, changed_ns: int) -> tuple[str, ...]:
    """Digests of a page's inline scripts, as a content security policy names them."""
    scripts = INLINE_SCRIPT.findall(page.read_bytes())
    return tuple(f"sha256-{base64.b64encode(hashlib.sha256(text).digest()).decode()}" for text in scripts)
