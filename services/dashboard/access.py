"""Who may look: an API key typed into a form becomes a signed cookie, which every page asks for.

The cookie holds the key's id and an expiry under an HMAC; it is HttpOnly and SameSite=Strict, and of no use
to the REST API. The key itself is looked up again for every page, so a revoked key is out at once. What
changes something must come from one of our own pages (``require_same_origin``).
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import time
from pathlib import Path
from typing import Annotated
from urllib.parse import quote, urlsplit

from fastapi import APIRouter, Depends, Form, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from starlette.exceptions import HTTPException

from services.dashboard.site import BASE, Site
from storage import api_keys

COOKIE = "physworld_session"
LIFETIME_SECONDS = 12 * 3600
SECRET_BYTES = 32
SECRET_NAME = "dashboard-secret"


class LoginRequired(Exception):
    """No valid session; ``app`` answers with the login form, or with 401 where no person would see a form."""


class Sessions:
    """Makes and reads session cookies."""

    def __init__(self, site: Site) -> None:
        self._database = site.database
        self._secret = _secret(site.settings.data_dir / SECRET_NAME)

    def issue(self, key_id: str) -> str:
        """A cookie's value for the holder of this key."""
        body = f"{key_id}.{int(time.time()) + LIFETIME_SECONDS}"
        return f"{body}.{self._signature(body)}"

    def viewer(self, cookie: str | None) -> api_keys.ApiKey | None:
        """The key behind a cookie, None when it is forged, over or its key revoked."""
        body, _, signature = (cookie or "").rpartition(".")
        if not hmac.compare_digest(self._signature(body).encode(), signature.encode()):
            return None
        key_id, _, expiry = body.partition(".")
        if int(expiry) < time.time():
            return None
        with self._database.reading() as session:
            return api_keys.get_active_key(session, key_id)

    def _signature(self, body: str) -> str:
        return hmac.new(self._secret, body.encode(), hashlib.sha256).hexdigest()


def require_viewer(request: Request) -> None:
    """Dependency of every page: puts the viewer's key on the request or raises LoginRequired."""
    sessions: Sessions = request.app.state.sessions
    viewer = sessions.viewer(request.cookies.get(COOKIE))
    if viewer is None:
        raise LoginRequired
    request.state.viewer = viewer
    request.state.key_id = viewer.id  # for the access log


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
        with site.database.reading() as session:
            found = api_keys.verify(session, key.strip())
        if found is None:
            refused = "This key is not known here, or it was revoked."
            return site.page(request, "login.html", status=401, next=_own_path(next), refused=refused)
        sessions: Sessions = request.app.state.sessions
        response = RedirectResponse(_own_path(next), 303)
        response.set_cookie(
            COOKIE,
            sessions.issue(found.id),
            max_age=LIFETIME_SECONDS,
            path=BASE,
            httponly=True,
            samesite="strict",
            secure=request.url.scheme == "https",
        )
        return response

    @routes.post("/logout", dependencies=[Depends(require_same_origin)])
    def logout() -> Response:
        response = RedirectResponse(f"{BASE}/login", 303)
        response.delete_cookie(COOKIE, path=BASE)
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


def _secret(path: Path) -> bytes:
    """The secret that signs cookies, kept beside the database so that a restart logs nobody out.

    Where the folder cannot be written (a read-only container) sessions last as long as the process.
    """
    made = secrets.token_bytes(SECRET_BYTES)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        kept = path.read_bytes()
        return kept if len(kept) == SECRET_BYTES else made
    except OSError:
        return made
    with os.fdopen(handle, "wb") as file:
        file.write(made)
    return made
