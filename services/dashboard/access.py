"""Who may look: an API key typed into a form opens a session, which every page asks for.

The session lies in the database (``physworld_storage.access.sessions``); the cookie holds a random text and nothing
else, is HttpOnly and SameSite=Strict, and of no use to the REST API. A log-out or a revoked key ends it at once, on
every web process. What changes something must come from one of our own pages (``require_same_origin``).
"""

from __future__ import annotations

from typing import Annotated, Any
from urllib.parse import quote, urlsplit

from fastapi import APIRouter, Depends, Form, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from starlette.exceptions import HTTPException

from physworld_services.api.errors import ApiProblem
from physworld_services.api.security import Gate, address_of
from physworld_services.dashboard.site import BASE, Site
from physworld_storage.access import api_keys, sessions
from physworld_storage.access.audit import Actor
from physworld_storage.database import Database

COOKIE = "physworld_session"
SECURE_COOKIE = f"__Host-{COOKIE}"  # a browser takes this name over TLS only, from this host, for this host


class LoginRequired(Exception):
    """No valid session; ``app`` answers with the login form, or with 401 where no person would see a form."""


def require_viewer(request: Request) -> None:
    """Dependency of every page: puts the viewer's key on the request or raises LoginRequired."""
    database: Database = request.app.state.site.database
    with database.reading() as session:
        found = sessions.viewer(session, _text_of(request))
    if found is None:
        raise LoginRequired
    viewer, to_touch = found
    if to_touch:
        with database.session() as session:
            sessions.touch(session, viewer.credential)
    request.state.viewer = viewer
    request.state.key_id = viewer.id  # for the access log
    request.state.credential = viewer.credential  # what a live part of a page ends with


def actor_of(request: Request) -> Actor:
    """Who looks and from where, for the audit log."""
    viewer: api_keys.ApiKey = request.state.viewer
    return Actor(viewer.id, address_of(request.scope))


def require_same_origin(request: Request) -> None:
    """Dependency of every POST: refuses a form that another site's page sent. Raises 403.

    Browsers name the sender in Sec-Fetch-Site, and in Origin where the connection is not a secure context.
    """
    site = request.headers.get("sec-fetch-site")
    origin = urlsplit(request.headers.get("origin", "")).netloc
    if site != "same-origin" and not (site is None and origin == request.headers.get("host")):
        raise HTTPException(403, "This form was not sent from a page of this dashboard.")


def require_writer(request: Request) -> None:
    """Dependency of what changes something: the key's role must allow it. Raises 403."""
    viewer: api_keys.ApiKey = request.state.viewer
    if not viewer.allows("write"):
        raise HTTPException(403, f"This needs a key that may write; this one may {viewer.role}.")


def router(site: Site) -> APIRouter:
    """The login form and the way out."""
    routes = APIRouter()

    @routes.get("/login")
    def form(request: Request, next: str = f"{BASE}/") -> HTMLResponse:
        return site.page(request, "login.html", next=_own_path(next), refused="")

    @routes.post("/login", dependencies=[Depends(require_same_origin)])
    def login(
        request: Request, key: Annotated[str, Form()] = "", next: Annotated[str, Form()] = f"{BASE}/"
    ) -> Response:
        gate: Gate = request.app.state.gate
        address = address_of(request.scope)
        try:
            found = gate.key_of(key.strip(), address)
        except ApiProblem as problem:
            refused = f"{problem.detail[0].upper()}{problem.detail[1:]}."
            answer = site.page(request, "login.html", status=429, next=_own_path(next), refused=refused)
            answer.headers.update(problem.headers or {})
            request.state.unlogged = True  # a flood fills no log
            return answer
        if found is None:
            gate.record("login.failed", address)
            refused = "This key is not known here, or it was revoked or has expired."
            return site.page(request, "login.html", status=401, next=_own_path(next), refused=refused)
        actor = Actor(found.id, address)
        with site.database.session() as session:
            sessions.end(session, api_keys.digest_of(_text_of(request)), actor)
            text = sessions.begin(session, found, actor)
        response = RedirectResponse(_own_path(next), 303)
        response.set_cookie(value=text, max_age=int(sessions.LIFETIME.total_seconds()), **_cookie(request))
        return response

    @routes.post("/logout", dependencies=[Depends(require_same_origin)])
    def logout(request: Request, everywhere: Annotated[bool, Form()] = False) -> Response:
        text = _text_of(request)
        with site.database.session() as session:
            found = sessions.viewer(session, text)
            if found is not None:
                actor = Actor(found[0].id, address_of(request.scope))
                if everywhere:
                    sessions.end_all(session, found[0].id, actor)
                else:
                    sessions.end(session, api_keys.digest_of(text), actor)
        response = RedirectResponse(f"{BASE}/login", 303)
        response.delete_cookie(**_cookie(request))
        return response

    return routes


def login_url(request: Request) -> str:
    """The login form that leads back to the page that was asked for."""
    here = request.url.path + (f"?{request.url.query}" if request.url.query else "")
    return f"{BASE}/login?next={quote(here)}"


def _own_path(path: str) -> str:
    """``path`` where it is one of the dashboard's, else the first page: a login never leads elsewhere."""
    plain = path.startswith(f"{BASE}/") and "\\" not in path and not path.startswith(f"{BASE}//")
    return path if plain else f"{BASE}/"


def _text_of(request: Request) -> str:
    """What the browser's cookie says; empty without one."""
    return request.cookies.get(_cookie(request)["key"], "")


def _cookie(request: Request) -> dict[str, Any]:
    """Name and attributes of the cookie. The name for TLS demands the path ``/``."""
    secure = request.url.scheme == "https"
    name, path = (SECURE_COOKIE, "/") if secure else (COOKIE, BASE)
    return {"key": name, "path": path, "httponly": True, "samesite": "strict", "secure": secure}
