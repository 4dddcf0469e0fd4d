"""Pictures that come in through a page: looked at, boxes drawn on the first one, and a job that makes the scene.

What a browser does with them is in ``frontend/src/tracking.js``; the forms that it posts are those of the REST API.
"""

from __future__ import annotations

from collections.abc import Callable

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, JSONResponse
from starlette.concurrency import run_in_threadpool

from physworld_scenes.errors import SceneInvalid
from physworld_schemas.tracking import TrackingOptions
from physworld_services.api.errors import ApiProblem
from physworld_services.api.parsing import Parsers
from physworld_services.api.uploads import Upload, kept_pictures, pictured, read_form, upload_of
from physworld_services.dashboard.access import require_same_origin, require_writer
from physworld_services.dashboard.pages_uploads import fault_lines
from physworld_services.dashboard.site import BASE, Site
from physworld_storage.jobs import jobs

Answer = Callable[[Upload[TrackingOptions]], JSONResponse]


def router(site: Site, parsers: Parsers) -> APIRouter:
    """``/trackings``: the page, and what it posts."""
    routes = APIRouter(prefix="/trackings", dependencies=[Depends(require_writer)])

    @routes.get("")
    def page(request: Request) -> HTMLResponse:
        return site.page(request, "tracking.html")

    @routes.post("/preview", dependencies=[Depends(require_same_origin)])
    async def preview(request: Request) -> JSONResponse:
        return await _answered(
            site, request, lambda upload: JSONResponse(pictured(upload, parsers).model_dump())
        )

    @routes.post("", dependencies=[Depends(require_same_origin)])
    async def start(request: Request) -> JSONResponse:
        return await _answered(site, request, lambda upload: _started(site, upload))

    return routes


async def _answered(site: Site, request: Request, answer: Answer) -> JSONResponse:
    """The answer to an upload, or what is wrong with it."""
    try:
        form = await read_form(request)
        try:
            upload = upload_of(form, site.settings.max_upload_bytes, TrackingOptions)
            return await run_in_threadpool(answer, upload)
        finally:
            await form.close()
    except SceneInvalid as error:
        told = "These pictures cannot be used"
        return JSONResponse({"told": told, "faults": fault_lines(error.faults)}, 422)
    except ApiProblem as problem:
        lines = fault_lines(problem.errors)
        return JSONResponse({"told": str(problem.detail), "faults": lines}, problem.status_code)


def _started(site: Site, upload: Upload[TrackingOptions]) -> JSONResponse:
    artifact = kept_pictures(upload, site.artifacts)
    with site.database.session() as session:
        job = jobs.create_tracking(session, artifact, upload.options)
    return JSONResponse({"place": f"{BASE}/jobs/{job.id}"}, 202)
