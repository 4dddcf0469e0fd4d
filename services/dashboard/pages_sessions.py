"""The open sessions of the viewer's key: where each came from, and the way to end one or all."""

from __future__ import annotations

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from physworld_services.dashboard.access import actor_of, require_same_origin
from physworld_services.dashboard.site import BASE, Site
from physworld_storage.access import sessions


def router(site: Site) -> APIRouter:
    """Pages below ``/sessions``."""
    routes = APIRouter()

    @routes.get("/sessions")
    def page(request: Request) -> HTMLResponse:
        viewer = request.state.viewer
        with site.database.reading() as session:
            found = sessions.list_sessions(session, viewer.id)
        return site.page(request, "sessions.html", entries=found, own=viewer.credential)

    @routes.post("/sessions/{credential}/end", dependencies=[Depends(require_same_origin)])
    def end(request: Request, credential: str) -> Response:
        with site.database.session() as session:
            if credential in {
                found.credential for found in sessions.list_sessions(session, request.state.viewer.id)
            }:
                sessions.end(session, credential, actor_of(request))
        return RedirectResponse(f"{BASE}/sessions", 303)

    return routes
