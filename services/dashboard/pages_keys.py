"""API keys, for administrators: the list, a new one (its token is shown once), another token, the end of one; the keys
that sign models, and the audit log."""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Form, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import ValidationError
from starlette.exceptions import HTTPException

from physworld_schemas.base import TEXTS
from physworld_schemas.key import DEFAULT_GRACE_MINUTES, KeyCreate, Role
from physworld_services.dashboard.access import actor_of, require_same_origin
from physworld_services.dashboard.lists import Asked, Looked
from physworld_services.dashboard.site import BASE, Site
from physworld_storage import signing
from physworld_storage.access import api_keys, audit

PAGE_SIZE = 50
EVERYTHING = Looked()
ROLES: dict[Role, str] = {"read": "look", "write": "look and start work", "admin": "also manage keys"}


def require_admin(request: Request) -> None:
    """Dependency of every page here. Raises 403."""
    viewer: api_keys.ApiKey = request.state.viewer
    if not viewer.allows("admin"):
        raise HTTPException(403, f"Keys are managed with an admin key; this one may {viewer.role}.")


def router(site: Site) -> APIRouter:
    """Pages below ``/keys``."""
    routes = APIRouter(prefix="/keys", dependencies=[Depends(require_admin)])

    def page(
        request: Request,
        asked: Looked = EVERYTHING,
        made: str | None = None,
        fault: str = "",
        status: int = 200,
    ) -> HTMLResponse:
        with site.database.reading() as session:
            found = api_keys.list_keys(session, limit=PAGE_SIZE, cursor=asked.cursor, search=asked.q)
            signing_keys = signing.list_signing_keys(session, limit=PAGE_SIZE).data
        context: dict[str, Any] = {"keys": found.data, **asked.context(found.next_cursor)}
        context |= {"roles": ROLES, "token": made, "fault": fault, "signing_keys": signing_keys}
        return site.page(request, "keys.html", status=status, **context)

    @routes.get("")
    def index(request: Request, asked: Asked) -> HTMLResponse:
        return page(request, asked)

    @routes.get("/audit")
    def audit_log(request: Request, asked: Asked) -> HTMLResponse:
        with site.database.reading() as session:
            found = audit.list_entries(session, limit=PAGE_SIZE, cursor=asked.cursor)
            names = api_keys.names_of(session, (entry.actor for entry in found.data if entry.actor))
        context = asked.context(found.next_cursor)
        return site.page(request, "audit.html", entries=found.data, names=names, **context)

    @routes.post("", dependencies=[Depends(require_same_origin)])
    def create(
        request: Request,
        name: Annotated[str, Form()] = "",
        role: Annotated[str, Form()] = "read",
        days: Annotated[str, Form()] = "",
    ) -> HTMLResponse:
        try:
            asked = KeyCreate.model_validate(
                {"name": name.strip(), "role": role, "expires_in_days": days or None}, context=TEXTS
            )
        except ValidationError as error:
            fault = "; ".join(f"{fault['loc'][0]}: {fault['msg']}" for fault in error.errors())
            return page(request, fault=fault, status=422)
        with site.database.session() as session:
            _, token = api_keys.create_key(
                session, asked.name, asked.role, lifetime_days=asked.expires_in_days, by=actor_of(request)
            )
        return page(request, made=token, status=201)

    @routes.post("/{key_id}/rotate", dependencies=[Depends(require_same_origin)])
    def rotate(request: Request, key_id: str) -> HTMLResponse:
        grace = timedelta(minutes=DEFAULT_GRACE_MINUTES)
        with site.database.session() as session:
            _, token, _ = api_keys.rotate_key(session, key_id, grace, by=actor_of(request))
        return page(request, made=token)

    @routes.post("/{key_id}/revoke", dependencies=[Depends(require_same_origin)])
    def revoke(request: Request, key_id: str) -> Response:
        with site.database.session() as session:
            api_keys.revoke_key(session, key_id, by=actor_of(request))
        return RedirectResponse(f"{BASE}/keys", 303)

    return routes
