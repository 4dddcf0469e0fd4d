"""Trackings: pictures of an object in motion, uploaded, that a job makes a scene of."""

from __future__ import annotations

from typing import cast

import anyio
from fastapi import APIRouter, Request, Response

from physworld_schemas.job import Job
from physworld_schemas.tracking import TrackingOptions, TrackingPreview
from physworld_services.api.dependencies import SettingsDep, StoresDep
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import Idempotency, IdempotencyDep, accepted
from physworld_services.api.parsing import Parsers
from physworld_services.api.uploads import (
    Upload,
    kept_pictures,
    pictured,
    read_form,
    recording_form,
    upload_of,
)
from physworld_services.stores import Stores
from physworld_storage.jobs import jobs

router = APIRouter(prefix="/trackings", tags=["trackings"])

BODY = recording_form(
    "zip or tar of a folder of pictures (color beside depth, or of one camera), or a film: MP4, MKV, AVI",
    "a TrackingOptions",
)


@router.post(
    "",
    status_code=202,
    response_model=Job,
    responses=documented(400, 401, 403, 413, 415, 422, 503, 507),
    openapi_extra=BODY,
)
async def create_tracking(
    request: Request, settings: SettingsDep, stores: StoresDep, idempotency: IdempotencyDep
) -> Response:
    """Follow an object in pictures; the job's output is the scene, with `followed.png` among its artifacts."""
    slots = cast(anyio.CapacityLimiter, request.app.state.upload_slots)
    form = await read_form(request)
    try:
        upload = upload_of(form, settings.max_upload_bytes, TrackingOptions)
        return await anyio.to_thread.run_sync(_opened, upload, stores, idempotency, limiter=slots)
    finally:
        await form.close()


@router.post(
    "/preview",
    response_model=TrackingPreview,
    responses=documented(400, 401, 403, 413, 415, 422, 503, 507),
    openapi_extra=BODY,
)
async def preview_tracking(
    request: Request, settings: SettingsDep, idempotency: IdempotencyDep
) -> TrackingPreview:
    """The first picture of each camera, in whose pixels the options speak; nothing is stored."""
    # A key is taken as by every POST, but no answer is kept for it: to look again is harmless, and answers are large.
    slots = cast(anyio.CapacityLimiter, request.app.state.upload_slots)
    form = await read_form(request)
    try:
        upload = upload_of(form, settings.max_upload_bytes, TrackingOptions)
        parsers = cast(Parsers, request.app.state.parsers)
        return await anyio.to_thread.run_sync(pictured, upload, parsers, limiter=slots)
    finally:
        await form.close()


def _opened(upload: Upload[TrackingOptions], stores: Stores, idempotency: Idempotency) -> Response:
    artifact = kept_pictures(upload, stores.artifacts)
    return idempotency.run(
        upload.fingerprint(),
        lambda session: accepted(jobs.create_tracking(session, artifact, upload.options)),
    )
