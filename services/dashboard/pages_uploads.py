"""Recordings that come in through a page: a file or an archive, the sample scene in one click, pictures beside a scene.

A folder that is dropped on the page is packed in the browser (``frontend/src/upload.js``); here every upload is one
file, read as the REST API reads it: by another process, under limits.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException

from physworld_scenes.errors import SceneInvalid
from physworld_schemas.base import FieldError
from physworld_schemas.scene import Scene, SceneImport
from physworld_schemas.video import PictureName
from physworld_services.api.errors import ApiProblem
from physworld_services.api.parsing import Found, Parsers
from physworld_services.api.routes.videos import picture_of, stored_picture
from physworld_services.api.uploads import Upload, looked_at, parsed, read_form, upload_of
from physworld_services.dashboard.access import require_same_origin, require_writer
from physworld_services.dashboard.samples import PACKED, SAMPLE, sample_folder
from physworld_services.dashboard.site import BASE, Site
from physworld_storage import resources, videos

ARCHIVE_NAME = "scene.zip"


def router(site: Site, parsers: Parsers) -> APIRouter:
    """What is posted to ``/scenes``."""
    routes = APIRouter(dependencies=[Depends(require_same_origin), Depends(require_writer)])

    @routes.post("/scenes")
    async def upload(request: Request) -> Response:
        try:
            form = await read_form(request)
            try:
                given = upload_of(form, site.settings.max_upload_bytes, SceneImport)
                scene = await run_in_threadpool(_uploaded, site, given, parsers)
            finally:
                await form.close()
        except SceneInvalid as error:
            return _refused(site, request, "This recording cannot be used", error.faults, 422)
        except ApiProblem as problem:
            return _refused(site, request, str(problem.detail), problem.errors, problem.status_code)
        return _done(request, scene)

    @routes.post("/scenes/preview")
    async def preview(request: Request) -> JSONResponse:
        try:
            form = await read_form(request)
            try:
                given = upload_of(form, site.settings.max_upload_bytes, SceneImport)
                found = await run_in_threadpool(looked_at, given, parsers)
            finally:
                await form.close()
        except SceneInvalid as error:
            told = "The recording needs another word from you"
            return JSONResponse({"told": told, "faults": fault_lines(error.faults)}, 422)
        except ApiProblem as problem:
            lines = fault_lines(problem.errors)
            return JSONResponse({"told": str(problem.detail), "faults": lines}, problem.status_code)
        return JSONResponse(found.model_dump())

    @routes.post("/scenes/sample")
    async def sample(request: Request) -> Response:
        folder = sample_folder()
        if folder is None:
            return _refused(site, request, "This installation has no sample scene", [], 404)
        return _done(request, await run_in_threadpool(_sample, site, folder, parsers))

    @routes.post("/scenes/{scene_id}/pictures/{name}")
    async def picture(request: Request, scene_id: str, name: PictureName) -> Response:
        try:
            form = await read_form(request)
            try:
                file = picture_of(form, site.settings.max_upload_bytes)
                await run_in_threadpool(_pictured, site, scene_id, name, file)
            finally:
                await form.close()
        except ApiProblem as problem:
            faults = [fault for fault in problem.errors if fault.msg != problem.detail]
            told = "; ".join([str(problem.detail), *fault_lines(faults)])
            raise HTTPException(problem.status_code, f"{told}.") from problem
        return RedirectResponse(f"{BASE}/scenes/{scene_id}#pictures", 303)

    return routes


def _pictured(site: Site, scene_id: str, name: PictureName, file: UploadFile) -> None:
    with site.database.reading() as session:
        resources.get_scene(session, scene_id)
    artifact = stored_picture(file, name, site.stores)
    with site.database.session() as session:
        videos.put_picture(session, scene_id, artifact)


def _uploaded(site: Site, given: Upload[SceneImport], parsers: Parsers) -> Scene:
    with parsed(given, parsers) as found:
        return _stored(site, found)


def _sample(site: Site, source: Path, parsers: Parsers) -> Scene:
    with TemporaryDirectory(prefix="physworld-sample-") as name:
        folder = Path(name)
        with zipfile.ZipFile(folder / "upload", "w", zipfile.ZIP_DEFLATED) as archive:
            for packed in PACKED:
                archive.write(source / packed, packed)
        return _stored(site, parsers.parse(folder, f"{SAMPLE}.zip", None, {}))


def _stored(site: Site, found: Found) -> Scene:
    artifact = site.artifacts.put_file(found.archive, ARCHIVE_NAME, "application/zip")
    with site.database.session() as session:
        known = resources.find_scene(session, artifact.sha256)
        return known or resources.create_scene(
            session, digest=artifact.sha256, artifacts=[artifact], **found.facts
        )


def _done(request: Request, scene: Scene) -> Response:
    place = f"{BASE}/scenes/{scene.id}"
    return JSONResponse({"place": place}, 201) if _by_script(request) else RedirectResponse(place, 303)


def _refused(
    site: Site, request: Request, told: str, faults: list[FieldError], status: int
) -> HTMLResponse | JSONResponse:
    lines = fault_lines(faults)
    if _by_script(request):
        return JSONResponse({"told": told, "faults": lines}, status)
    return site.page(
        request, "upload.html", status=status, told=told, faults=lines, has_sample=sample_folder() is not None
    )


def fault_lines(faults: list[FieldError]) -> list[str]:
    """Where each fault is, and what."""
    return [f"{'.'.join(str(part) for part in fault.loc)}: {fault.msg}" for fault in faults]


def _by_script(request: Request) -> bool:
    return "application/json" in request.headers.get("accept", "")
