"""A scene file on its way in: multipart parts to a temporary file, parsed, named, made canonical.

The file is read while it streams into a temporary file (``limits`` bounds it), then parsed in another process
(``physworld_services.api.parsing``). The temporary files are gone when the request is.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Generic, TypeVar

from fastapi import Request
from pydantic import ValidationError
from starlette.datastructures import FormData, UploadFile

from physworld_scenes.archives import is_tar, is_zip
from physworld_scenes.declaration import KINDS
from physworld_scenes.errors import refused
from physworld_scenes.importers.film import begins_as_film
from physworld_schemas.base import Artifact, FieldError
from physworld_schemas.scene import RecordingFacts, SceneImport, ScenePreview
from physworld_schemas.tracking import TrackingOptions, TrackingPreview
from physworld_services.api.errors import ApiProblem
from physworld_services.api.limits import too_large
from physworld_services.api.parsing import Found, Parsers
from physworld_storage.artifacts import ArtifactStore

Options = TypeVar("Options", bound=RecordingFacts)
FIELDS = frozenset({"bundle", "name", "options"})
FIELD_LIMIT_BYTES = 64 * 1024
COPIED_BYTES = 1024 * 1024
HEAD_BYTES = 512


def form_of(properties: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """What OpenAPI says of a form that is sent with a file.

    Args:
        properties: schema of each field by name; the file is the field ``bundle``, which has to be there.
    """
    schema = {
        "type": "object",
        "required": ["bundle"],
        "additionalProperties": False,
        "properties": properties,
    }
    form = {"schema": schema, "encoding": {"bundle": {"contentType": "application/octet-stream"}}}
    return {"requestBody": {"required": True, "content": {"multipart/form-data": form}}}


def recording_form(bundle: str, options: str) -> dict[str, Any]:
    """What OpenAPI says of the form of a recording.

    Args:
        bundle: what the file is.
        options: the model of the options, with its article.
    """
    return form_of(
        {
            "bundle": {"type": "string", "format": "binary", "description": bundle},
            "name": {
                "type": "string",
                "minLength": 1,
                "maxLength": 128,
                "description": "name of the scene, in the place of the one that it brings",
            },
            "options": {"type": "string", "description": f"{options} as JSON"},
        }
    )


MULTIPART_BODY = recording_form(
    "zip or tar of scene.json and scene.npz, PhysTwin's final_data.pkl, or a table of markers (GET /v1/importers)",
    "a SceneImport",
)


@dataclass(frozen=True)
class Upload(Generic[Options]):
    """What was sent: the open file, its name, and what completes it."""

    file: UploadFile
    options: Options

    def fingerprint(self) -> str:
        """What makes two uploads the same one, whatever their multipart boundary."""
        digest = hashlib.sha256()
        self.file.file.seek(0)
        while piece := self.file.file.read(1 << 20):
            digest.update(piece)
        return f"{self.file.filename}\n{self.options.model_dump_json()}\n{digest.hexdigest()}"


async def read_form(request: Request) -> FormData:
    """The multipart parts of a request. Raises the problems 400 (malformed) and 415 (another media type)."""
    media_type = request.headers.get("Content-Type", "")
    if not media_type.lower().startswith("multipart/form-data"):
        raise ApiProblem(
            415,
            "unsupported_media_type",
            f"Content-Type is {media_type or 'missing'!r}; send multipart/form-data with the file in bundle",
        )
    return await request.form(max_files=1, max_fields=len(FIELDS), max_part_size=FIELD_LIMIT_BYTES)


def upload_of(form: FormData, limit_bytes: int, model: type[Options]) -> Upload[Options]:
    """The upload in a form, its options of that model. Raises the problems 413 and 422."""
    faults = [_fault("is not a field of this form", name) for name in form if name not in FIELDS]
    file = form.get("bundle")
    if not isinstance(file, UploadFile):
        raise _invalid([*faults, _fault("the file is missing", "bundle")])
    options = _options(form.get("name"), form.get("options"), faults, model)
    if faults:
        raise _invalid(faults)
    if file.size is not None and file.size > limit_bytes:
        raise too_large(file.size, limit_bytes)
    return Upload(file, options)


def looked_at(upload: Upload[SceneImport], parsers: Parsers) -> ScenePreview:
    """What an import of the upload would guess, found in another process. Raises SceneInvalid."""
    given = {name: value for name, value in upload.options.model_dump().items() if value is not None}
    with tempfile.TemporaryDirectory(prefix="physworld-upload-") as folder:
        _copied(upload, Path(folder))
        return ScenePreview.model_validate(parsers.look(Path(folder), upload.file.filename or "", given))


@contextmanager
def parsed(upload: Upload[SceneImport], parsers: Parsers) -> Iterator[Found]:
    """What the upload holds, read in another process; its files go with the block. Raises SceneInvalid."""
    given = {name: value for name, value in upload.options.model_dump().items() if value is not None}
    with tempfile.TemporaryDirectory(prefix="physworld-upload-") as folder:
        _copied(upload, Path(folder))
        yield parsers.parse(Path(folder), upload.file.filename or "", upload.options.name, given)


def pictured(upload: Upload[TrackingOptions], parsers: Parsers) -> TrackingPreview:
    """What an archive of pictures holds, found in another process. Raises SceneInvalid."""
    with tempfile.TemporaryDirectory(prefix="physworld-upload-") as folder:
        _copied(upload, Path(folder))
        said = upload.options.model_dump(include={"up", "boxes", "depth_scale"})
        return TrackingPreview.model_validate(
            parsers.pictures(Path(folder), upload.file.filename or "", said)
        )


def kept_pictures(upload: Upload[TrackingOptions], artifacts: ArtifactStore) -> Artifact:
    """The file in the store, once its beginning was looked at. Raises SceneInvalid."""
    filename = PurePosixPath((upload.file.filename or "").replace("\\", "/")).name
    name = "".join(letter if letter.isprintable() else "_" for letter in filename)[:128] or "recording"
    upload.file.file.seek(0)
    head = upload.file.file.read(HEAD_BYTES)
    if not (is_zip(head) or is_tar(head) or begins_as_film(head)):
        start = head[:8].hex(" ") or "nothing"
        raise refused(
            name, f"is neither an archive (zip, tar) nor a film (MP4, MKV, AVI): it begins with {start}"
        )
    with tempfile.TemporaryDirectory(prefix="physworld-upload-") as folder:
        _copied(upload, Path(folder))
        return artifacts.put_file(Path(folder) / "upload", name)


def _copied(upload: Upload[Options], folder: Path) -> None:
    upload.file.file.seek(0)
    with (folder / "upload").open("wb") as file:
        shutil.copyfileobj(upload.file.file, file, COPIED_BYTES)


def _options(
    name: UploadFile | str | None,
    text: UploadFile | str | None,
    faults: list[FieldError],
    model: type[Options],
) -> Options:
    """The options in a form; what is wrong with them is added to the faults.

    Args:
        name: of the scene, beside the options.
        text: their JSON.
        faults: of the form.
        model: of the options.
    """
    if isinstance(name, UploadFile) or isinstance(text, UploadFile):
        faults.append(_fault("name and options are text, not files"))
        return model()
    try:
        options = model.model_validate_json(text or "{}")
        if name is not None:
            options = model.model_validate({**options.model_dump(), "name": name})
    except ValidationError as error:
        faults += [_fault(fault["msg"], "options", *fault["loc"]) for fault in error.errors()]
        return model()
    if options.kind is not None and options.kind not in KINDS:
        faults.append(_fault(f"{options.kind!r}; known: {', '.join(KINDS)}", "options", "kind"))
    return options


def _fault(message: str, *where: str | int) -> FieldError:
    return FieldError(loc=["body", *where], msg=message)


def _invalid(faults: list[FieldError]) -> ApiProblem:
    detail = "; ".join(f"{'.'.join(map(str, fault.loc))}: {fault.msg}" for fault in faults)
    return ApiProblem(422, "invalid_request", detail, errors=faults)
