"""The dashboard as an application of its own, mounted under /dashboard of the web process.

Being its own application it has its own error pages, its own answer to a missing login (a form, not a
problem document) and its own strict content security policy: scripts, styles and data come from this server
and nothing is inline.
"""

from __future__ import annotations

from http import HTTPStatus

from fastapi import Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import PlainTextResponse, RedirectResponse, Response
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import GZipMiddleware
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from physworld_services.api.attempts import Attempts
from physworld_services.api.parsing import Parsers
from physworld_services.api.security import Gate
from physworld_services.dashboard import (
    access,
    pages_datasets,
    pages_files,
    pages_jobs,
    pages_keys,
    pages_models,
    pages_objects,
    pages_playground,
    pages_runs,
    pages_scenes,
    pages_sessions,
    pages_start,
    pages_traces,
    pages_trackings,
    pages_uploads,
    pages_videos,
)
from physworld_services.dashboard.site import BASE, STATIC, Site
from physworld_services.stores import Stores
from physworld_storage.database import Database
from physworld_storage.errors import (
    ArtifactCorrupt,
    Conflict,
    DatabaseUnavailable,
    EpisodeCorrupt,
    InvalidCursor,
    NotFound,
    StorageError,
    StoreError,
)
from physworld_storage.settings import Settings

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; media-src 'self'; "
    "font-src 'self'; connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
HEADINGS = {
    404: "This page does not exist",
    403: "This key may not do that",
    409: "That is not possible now",
    422: "Something in the form is wrong",
    503: "The service cannot answer right now",
}
FOREVER = "public, max-age=31536000, immutable"


def mount(app: FastAPI, settings: Settings, database: Database, stores: Stores) -> None:
    """Add the dashboard to the web process: pages and static files under /dashboard.

    Args:
        app: the web process, with the API's gate and parsers in its state where it serves the API.
        settings: of the installation.
        database: holds rows and sessions.
        stores: hold the files.
    """
    gate = getattr(app.state, "gate", None) or Gate(
        database, Attempts()
    )  # one with the API's, where there is one
    parsers = getattr(app.state, "parsers", None) or Parsers(1)
    dashboard = create_dashboard(Site(settings, database, stores), gate, parsers)

    @app.get(BASE, include_in_schema=False)
    def without_slash() -> RedirectResponse:
        return RedirectResponse(f"{BASE}/", 307)

    app.mount(BASE, dashboard, name="dashboard")


def create_dashboard(site: Site, gate: Gate, parsers: Parsers) -> FastAPI:
    """The application itself, for paths relative to /dashboard."""
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    app.state.site, app.state.gate = site, gate
    app.include_router(access.router(site))
    pages = (
        pages_jobs,
        pages_scenes,
        pages_traces,
        pages_datasets,
        pages_playground,
        pages_models,
        pages_files,
        pages_sessions,
        pages_runs,
        pages_start,
        pages_objects,
        pages_keys,
        pages_videos,
    )
    viewing = [Depends(access.require_viewer)]
    for module in pages:
        app.include_router(module.router(site), dependencies=viewing)
    for taking in (pages_uploads, pages_trackings):
        app.include_router(taking.router(site, parsers), dependencies=viewing)
    app.mount("/static", GZipMiddleware(StaticFiles(directory=STATIC), minimum_size=1024))
    app.add_middleware(SecurityHeaders)
    _install_errors(app, site)
    return app


class SecurityHeaders:
    """ASGI middleware: the policy on every answer that has none of its own; pages are not kept by any cache."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and add the headers to its answer."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        is_static = scope["path"].startswith(f"{BASE}/static/")

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
                named_by_content = b"v=" in scope["query_string"] or "/chunk-" in scope["path"]
                fresh = is_static and named_by_content
                headers.setdefault(
                    "Cache-Control", FOREVER if fresh else "no-cache" if is_static else "no-store"
                )
            await send(message)

        await self.app(scope, receive, send_with_headers)


def _install_errors(app: FastAPI, site: Site) -> None:
    def answer(request: Request, status: int, detail: str) -> Response:
        if not _wants_page(request):
            return PlainTextResponse(detail, status)
        _know_the_viewer(request, site)
        heading = HEADINGS.get(status, HTTPStatus(status).phrase)
        request_id = request.scope.get("state", {}).get("request_id") if status >= 500 else None
        return site.page(
            request, "error.html", status=status, heading=heading, detail=detail, request_id=request_id
        )

    @app.exception_handler(access.LoginRequired)
    def login_required(request: Request, error: access.LoginRequired) -> Response:
        if not _wants_page(request) or request.method != "GET":
            return PlainTextResponse("log in first", 401)
        return RedirectResponse(access.login_url(request), 303)

    @app.exception_handler(NotFound)
    def not_found(request: Request, error: NotFound) -> Response:
        return answer(request, 404, f"There is {error}.")

    @app.exception_handler(Conflict)
    def conflict(request: Request, error: Conflict) -> Response:
        return answer(request, 409, f"{error}.")

    @app.exception_handler(InvalidCursor)
    def invalid_cursor(request: Request, error: InvalidCursor) -> Response:
        return answer(request, 400, f"{error}.")

    @app.exception_handler(RequestValidationError)
    def invalid(request: Request, error: RequestValidationError) -> Response:
        if request.method != "GET":
            faults = (f"{fault['loc'][-1]}: {fault['msg']}" for fault in error.errors())
            return answer(request, 422, f"{'; '.join(faults)}.")
        return answer(request, 404, "The address holds a value that cannot be.")

    @app.exception_handler(DatabaseUnavailable)
    @app.exception_handler(StoreError)
    def unavailable(request: Request, error: StorageError) -> Response:
        told = answer(request, 503, f"{error.told}. Nothing was changed; try again in a moment.")
        told.headers["Retry-After"] = "2"
        return told

    @app.exception_handler(ArtifactCorrupt)
    @app.exception_handler(EpisodeCorrupt)
    def corrupt(request: Request, error: Exception) -> Response:
        return answer(request, 500, f"{error}.")

    @app.exception_handler(HTTPException)
    def refused(request: Request, error: HTTPException) -> Response:
        detail = "Nothing is at this address." if error.status_code == 404 else str(error.detail)
        return answer(request, error.status_code, detail)

    @app.exception_handler(Exception)
    def unexpected(request: Request, error: Exception) -> Response:
        return answer(request, 500, "Something went wrong on our side.")


def _know_the_viewer(request: Request, site: Site) -> None:
    """Who looks, for the navigation of an error page of an address that no route has."""
    if getattr(request.state, "viewer", None) is None:
        try:
            access.require_viewer(request)
        except (access.LoginRequired, DatabaseUnavailable):
            return


def _wants_page(request: Request) -> bool:
    """Whether a person sees the answer: scripts ask for data with another Accept header."""
    accepts_page = "text/html" in request.headers.get("accept", "")
    return accepts_page and "hx-request" not in request.headers
