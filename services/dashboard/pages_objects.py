"""What people do with an object from its page: delete it, describe a version, move an alias."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Depends, Form, Request
from fastapi.responses import RedirectResponse, Response
from pydantic import ValidationError
from starlette.exceptions import HTTPException

from physworld_schemas.base import Request as Change
from physworld_schemas.model import VersionPatch
from physworld_schemas.scene import ScenePatch
from physworld_services.api.routes.removal import delete_object
from physworld_services.dashboard.access import actor_of, require_same_origin, require_writer
from physworld_services.dashboard.site import BASE, Site
from physworld_storage import registry, removal, resources
from physworld_storage.access import audit
from physworld_storage.errors import NotFound

AFTERWARDS = {"fit": "fits", "scene": "scenes", "trace": "traces", "dataset": "datasets"}
AFTERWARDS |= {
    "check": "scenes",
    "rollout": "rollouts",
    "plan": "plans",
    "assessment": "models",
    "video": "scenes",
}
Patch = TypeVar("Patch", bound=Change)
ALIAS = r"^[a-z][a-z0-9_-]{0,31}$"


def router(site: Site) -> APIRouter:
    """Everything here changes something: it is posted, by one of our pages, with a key that may write."""
    routes = APIRouter(dependencies=[Depends(require_same_origin), Depends(require_writer)])

    @routes.post("/delete/{kind}/{object_id}")
    def delete(request: Request, kind: str, object_id: str) -> Response:
        if kind not in AFTERWARDS:
            raise NotFound("kind of object", kind)
        delete_object(site.database, site.stores, actor_of(request), kind, object_id)
        return RedirectResponse(f"{BASE}/{AFTERWARDS[kind]}", 303)

    @routes.post("/models/{name}/{number}/delete")
    def delete_version(request: Request, name: str, number: int) -> Response:
        with site.database.session() as session:
            removal.remove_version(session, name, number)
            audit.record(session, actor_of(request), "model.deleted", f"{name}:{number}")
        return RedirectResponse(f"{BASE}/models/{name}", 303)

    @routes.post("/scenes/{scene_id}/label")
    def label_scene(scene_id: str, tags: Annotated[str, Form()] = "") -> Response:
        patch = _patch(ScenePatch, tags=_listed(tags))
        with site.database.session() as session:
            resources.patch_scene(session, scene_id, patch)
        return RedirectResponse(f"{BASE}/scenes/{scene_id}", 303)

    @routes.post("/models/{name}/{number}/label")
    def label(
        name: str, number: int, description: Annotated[str, Form()] = "", tags: Annotated[str, Form()] = ""
    ) -> Response:
        patch = _patch(VersionPatch, description=description.strip(), tags=_listed(tags))
        with site.database.session() as session:
            registry.patch_version(session, name, number, patch)
        return RedirectResponse(f"{BASE}/models/{name}/{number}", 303)

    @routes.post("/models/{name}/{number}/alias")
    def alias(
        request: Request, name: str, number: int, alias: Annotated[str, Form(pattern=ALIAS)]
    ) -> Response:
        with site.database.session() as session:
            registry.set_alias(session, name, alias, number)
            audit.record(session, actor_of(request), "alias.set", f"{name}@{alias}", version=number)
        return RedirectResponse(f"{BASE}/models/{name}/{number}", 303)

    @routes.post("/models/{name}/{number}/alias/{alias}/remove")
    def remove_alias(request: Request, name: str, number: int, alias: str) -> Response:
        with site.database.session() as session:
            registry.delete_alias(session, name, alias)
            audit.record(session, actor_of(request), "alias.removed", f"{name}@{alias}")
        return RedirectResponse(f"{BASE}/models/{name}/{number}", 303)

    return routes


def _listed(tags: str) -> list[str]:
    """Tags with commas between."""
    return [tag.strip() for tag in tags.split(",") if tag.strip()]


def _patch(model: type[Patch], **fields: Any) -> Patch:
    """What a form asks to change. Raises HTTPException, 422, with what the wire model says against it."""
    try:
        return model(**fields)
    except ValidationError as error:
        raise HTTPException(422, "; ".join(fault["msg"] for fault in error.errors())) from error
