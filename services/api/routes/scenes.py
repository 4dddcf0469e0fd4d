"""Scenes: upload a recording, read what was declared and measured."""

from __future__ import annotations

from typing import Annotated, cast

import anyio
from fastapi import APIRouter, Query, Request, Response
from sqlalchemy.orm import Session

from physworld_schemas.base import Page
from physworld_schemas.scene import Scene, SceneImport, ScenePatch, ScenePreview
from physworld_services.api.dependencies import DatabaseDep, ObjectId, PageDep, SettingsDep, StoresDep
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import Idempotency, IdempotencyDep, answer_of
from physworld_services.api.parsing import Parsers
from physworld_services.api.uploads import MULTIPART_BODY, Upload, looked_at, parsed, read_form, upload_of
from physworld_services.stores import Stores
from physworld_storage import resources
from physworld_storage.idempotency import Answer

router = APIRouter(prefix="/scenes", tags=["scenes"])

ARCHIVE_NAME = "scene.zip"


@router.post(
    "",
    status_code=201,
    response_model=Scene,
    responses={
        200: {"model": Scene, "description": "A scene with this content was there already"},
        **documented(400, 401, 403, 413, 415, 422, 503, 507),
    },
    openapi_extra=MULTIPART_BODY,
)
async def create_scene(
    request: Request, settings: SettingsDep, stores: StoresDep, idempotency: IdempotencyDep
) -> Response:
    """Upload a recording. It is checked as a whole; every fault is named in `errors`, with its numbers."""
    slots = cast(anyio.CapacityLimiter, request.app.state.upload_slots)
    form = await read_form(request)
    try:
        upload = upload_of(form, settings.max_upload_bytes, SceneImport)
        parsers = cast(Parsers, request.app.state.parsers)
        return await anyio.to_thread.run_sync(_register, upload, parsers, stores, idempotency, limiter=slots)
    finally:
        await form.close()


@router.post(
    "/preview",
    response_model=ScenePreview,
    responses=documented(400, 401, 403, 413, 415, 422, 503, 507),
    openapi_extra=MULTIPART_BODY,
)
async def preview_scene(request: Request, settings: SettingsDep, idempotency: IdempotencyDep) -> Response:
    """What an import of a recording would guess (axes, unit, rate, gripper, noise); nothing is stored."""
    slots = cast(anyio.CapacityLimiter, request.app.state.upload_slots)
    form = await read_form(request)
    try:
        upload = upload_of(form, settings.max_upload_bytes, SceneImport)
        parsers = cast(Parsers, request.app.state.parsers)
        return await anyio.to_thread.run_sync(_preview, upload, parsers, idempotency, limiter=slots)
    finally:
        await form.close()


@router.get("", responses=documented(401, 403, 422))
def list_scenes(
    database: DatabaseDep,
    page: PageDep,
    kind: Annotated[str | None, Query(max_length=32, pattern=r"^[a-z_]+$")] = None,
    tag: Annotated[
        str | None,
        Query(min_length=1, max_length=64, description="Only scenes with this tag.", examples=["soft"]),
    ] = None,
) -> Page[Scene]:
    """Scenes, newest first."""
    with database.reading() as session:
        return resources.list_scenes(session, limit=page.limit, cursor=page.cursor, kind=kind, tag=tag)


@router.get("/{scene_id}", responses=documented(401, 403, 404, 422))
def get_scene(scene_id: ObjectId, database: DatabaseDep) -> Scene:
    """A scene: what is declared of it, and the archive with the arrays among its artifacts."""
    with database.reading() as session:
        return resources.get_scene(session, scene_id)


@router.patch("/{scene_id}", responses=documented(401, 403, 404, 413, 422))
def patch_scene(scene_id: ObjectId, body: ScenePatch, database: DatabaseDep) -> Scene:
    """Give a scene other tags. The recording itself never changes."""
    with database.session() as session:
        return resources.patch_scene(session, scene_id, body)


def _preview(upload: Upload[SceneImport], parsers: Parsers, idempotency: Idempotency) -> Response:
    found = looked_at(upload, parsers)
    return idempotency.run(f"preview {upload.fingerprint()}", lambda session: answer_of(200, found))


def _register(
    upload: Upload[SceneImport], parsers: Parsers, stores: Stores, idempotency: Idempotency
) -> Response:
    with parsed(upload, parsers) as found:
        artifact = stores.artifacts.put_file(found.archive, ARCHIVE_NAME, "application/zip")
        facts = found.facts

    def work(session: Session) -> Answer:
        known = resources.find_scene(session, artifact.sha256)
        scene = known or resources.create_scene(
            session, digest=artifact.sha256, artifacts=[artifact], **facts
        )
        return answer_of(200 if known else 201, scene, {"Location": f"/v1/scenes/{scene.id}"})

    return idempotency.run(upload.fingerprint(), work)
