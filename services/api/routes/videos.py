"""Films: ask for one, read what was drawn; the film itself is an artifact. And the pictures that a scene may have."""

from __future__ import annotations

import shutil
import tempfile
from typing import Annotated, cast

import anyio
from fastapi import APIRouter, Query, Request, Response
from pydantic import ValidationError
from sqlalchemy.orm import Session
from starlette.datastructures import FormData, UploadFile

from physworld_schemas.base import Artifact, FieldError, Page
from physworld_schemas.job import Job
from physworld_schemas.scene import Scene
from physworld_schemas.video import MAX_CAMERA_BYTES, CameraView, PictureName, Video, VideoCreate, VideoOf
from physworld_services.api.dependencies import (
    ID_PATTERN,
    DatabaseDep,
    ObjectId,
    PageDep,
    SettingsDep,
    StoresDep,
)
from physworld_services.api.errors import ApiProblem, documented
from physworld_services.api.idempotency import Idempotency, IdempotencyDep, accepted, answer_of
from physworld_services.api.limits import too_large
from physworld_services.api.uploads import COPIED_BYTES, form_of, read_form
from physworld_services.stores import Stores
from physworld_storage import resources, videos
from physworld_storage.idempotency import Answer
from physworld_storage.jobs import jobs

router = APIRouter(tags=["videos"])

MEDIA_TYPES: dict[str, str] = {
    "splat.ply": "application/x-ply",
    "camera.json": "application/json",
    "frames.npz": "application/x-npz",
}
BEGINS: dict[str, tuple[bytes, str]] = {
    "splat.ply": (b"ply", "a splat in PLY"),
    "frames.npz": (b"PK\x03\x04", "an npz of pictures"),
}
PICTURE_BODY = form_of(
    {
        "bundle": {
            "type": "string",
            "format": "binary",
            "description": "the splat (PLY), the camera (JSON) or the pictures (npz with frames)",
        }
    }
)


@router.post(
    "/videos", status_code=202, response_model=Job, responses=documented(401, 403, 404, 409, 413, 422)
)
def create_video(body: VideoCreate, idempotency: IdempotencyDep) -> Response:
    """Draw a film of a motion; the film's id is in the job's `outputs`."""
    return idempotency.run(body, lambda session: accepted(jobs.create_video(session, body)))


@router.get("/videos", responses=documented(401, 403, 422))
def list_videos(
    database: DatabaseDep,
    page: PageDep,
    scene_id: Annotated[str | None, Query(pattern=ID_PATTERN)] = None,
    of: Annotated[VideoOf | None, Query(description="Only films of this kind of object.")] = None,
    source_id: Annotated[
        str | None, Query(pattern=r"^[A-Za-z0-9_.:-]{1,128}$", description="Only films of this object.")
    ] = None,
) -> Page[Video]:
    """Films, newest first."""
    with database.reading() as session:
        return videos.list_videos(
            session, limit=page.limit, cursor=page.cursor, scene_id=scene_id, of=of, source_id=source_id
        )


@router.get("/videos/{video_id}", responses=documented(401, 403, 404, 422))
def get_video(video_id: ObjectId, database: DatabaseDep) -> Video:
    """A film: what was drawn and how it compares with the scene's pictures; the artifact `film.mp4` is the film."""
    with database.reading() as session:
        return videos.get_video(session, video_id)


@router.post(
    "/scenes/{scene_id}/pictures/{name}",
    response_model=Scene,
    responses=documented(400, 401, 403, 404, 413, 415, 422, 503, 507),
    openapi_extra=PICTURE_BODY,
)
async def put_picture(
    scene_id: ObjectId,
    name: PictureName,
    request: Request,
    settings: SettingsDep,
    database: DatabaseDep,
    stores: StoresDep,
    idempotency: IdempotencyDep,
) -> Response:
    """Keep a splat, a camera or pictures beside a scene, for its films; one of the same name is replaced."""
    slots = cast(anyio.CapacityLimiter, request.app.state.upload_slots)
    form = await read_form(request)
    try:
        file = picture_of(form, settings.max_upload_bytes)
        with database.reading() as session:
            resources.get_scene(session, scene_id)
        return await anyio.to_thread.run_sync(_kept, file, name, scene_id, stores, idempotency, limiter=slots)
    finally:
        await form.close()


def picture_of(form: FormData, most_bytes: int) -> UploadFile:
    """The one file of a form. Raises ApiProblem, 413 or 422."""
    file = form.get("bundle")
    if not isinstance(file, UploadFile) or len(form) != 1:
        raise _refused("send one file in the field bundle and nothing else")
    if file.size is not None and file.size > most_bytes:
        raise too_large(file.size, most_bytes)
    return file


def stored_picture(file: UploadFile, name: str, stores: Stores) -> Artifact:
    """The file in the store, once it was looked at. Raises ApiProblem, 422."""
    file.file.seek(0)
    if name in BEGINS:
        magic, what = BEGINS[name]
        begin = file.file.read(len(magic))
        if begin != magic:
            raise _refused(f"{name} is {what} and begins with {magic!r}, not with {begin!r}")
    else:
        _check_camera(file.file.read(MAX_CAMERA_BYTES + 1))
    file.file.seek(0)
    with tempfile.NamedTemporaryFile(prefix="physworld-upload-") as copy:
        shutil.copyfileobj(file.file, copy, COPIED_BYTES)
        copy.flush()
        return stores.artifacts.put_file(copy.name, name, MEDIA_TYPES[name])


def _kept(file: UploadFile, name: str, scene_id: str, stores: Stores, idempotency: Idempotency) -> Response:
    artifact = stored_picture(file, name, stores)

    def work(session: Session) -> Answer:
        return answer_of(200, videos.put_picture(session, scene_id, artifact))

    return idempotency.run(f"{name} of {scene_id} {artifact.sha256}", work)


def _check_camera(content: bytes) -> None:
    if len(content) > MAX_CAMERA_BYTES:
        raise _refused(f"camera.json has more than {MAX_CAMERA_BYTES} bytes")
    try:
        CameraView.model_validate_json(content)
    except ValidationError as error:
        faults = [
            FieldError(loc=["body", "bundle", *fault["loc"]], msg=fault["msg"]) for fault in error.errors()
        ]
        raise ApiProblem(422, "invalid_request", "camera.json is no camera", errors=faults) from error


def _refused(message: str) -> ApiProblem:
    return ApiProblem(
        422, "invalid_request", message, errors=[FieldError(loc=["body", "bundle"], msg=message)]
    )
