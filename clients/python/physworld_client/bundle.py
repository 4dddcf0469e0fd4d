"""Packing a local scene for the upload.

A folder with ``scene.json`` and ``scene.npz`` becomes a zip of these two files and the meshes beside them, with fixed
time stamps, so that the same scene always gives the same bytes. A file of any form that the importers know is sent as
it is; the service tells by its content what it is and checks it. Nothing is unpickled here.
"""

from __future__ import annotations

import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO

from physworld_client.errors import BundleUnreadable
from physworld_schemas.video import PictureName
from physworld_schemas.wording import pictures_among

BUNDLE_FILES = ("scene.json", "scene.npz")
MESH_SUFFIXES = (".obj", ".off", ".ply", ".stl")
FILMS = (".mp4", ".mkv", ".avi")
COMPRESSED = (".png", ".jpg", ".jpeg", ".npz", *FILMS)
PICTURED = (*COMPRESSED, ".npy", ".json", ".pkl", ".csv")
"""What belongs to a folder of pictures: those, their depth, tracks, cameras and logs."""
SPOOL_LIMIT_BYTES = 64 * 2**20
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)
PICTURES: dict[str, PictureName] = {".ply": "splat.ply", ".json": "camera.json", ".npz": "frames.npz"}
"""What a file beside a scene is, by its ending."""
MEDIA_TYPES = {".zip": "application/zip", ".gz": "application/gzip", ".tgz": "application/gzip"}


@dataclass(frozen=True)
class Upload:
    """A file to send: a seekable stream and the name under which it is sent. Closes the stream at exit."""

    stream: IO[bytes]
    filename: str
    media_type: str

    def __enter__(self) -> Upload:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stream.close()


def open_bundle(path: str | Path) -> Upload:
    """The scene at ``path``, ready to be sent.

    Raises:
        BundleUnreadable: nothing is there, or a folder lacks one of the two files.
    """
    source = Path(path).expanduser()
    if source.is_dir():
        return _pack_folder(source)
    return open_file(source)


def open_pictures(path: str | Path, files: Mapping[str, Path] | None = None) -> Upload:
    """Pictures of an object, ready to be sent: a folder becomes a zip, an archive or a film is sent as it is.

    Args:
        path: folder of pictures, archive of one, or film.
        files: by their names in the archive further ones, beside a folder or a film: masks, tracks, a log, a camera.

    Raises:
        BundleUnreadable: nothing is there, nothing is in it, or an archive is to take further files.
    """
    source = Path(path).expanduser()
    more = dict(files or {})
    if source.is_dir():
        entries = [(entry.relative_to(source).as_posix(), entry) for entry in sorted(source.rglob("*"))]
        held = {
            name: entry for name, entry in entries if entry.suffix.lower() in PICTURED and entry.is_file()
        }
        if not held:
            raise BundleUnreadable(f"{source} holds no pictures and no film")
        return _pack(source.resolve().name, held | more)
    if not more:
        return open_file(source)
    if source.suffix.lower() not in FILMS:
        raise BundleUnreadable(
            f"{source} is no folder and no film: {', '.join(more)} cannot be put beside it"
        )
    return _pack(source.stem, {source.name: source, **more})


def _pack(name: str, files: Mapping[str, Path]) -> Upload:
    """Files as one zip; what is compressed already is stored as it is."""
    stream = tempfile.SpooledTemporaryFile(max_size=SPOOL_LIMIT_BYTES)  # noqa: SIM115 (the upload closes it)
    try:
        with zipfile.ZipFile(stream, "w") as archive:
            for inside, path in files.items():
                entry = zipfile.ZipInfo(inside, ZIP_EPOCH)
                compressed = path.suffix.lower() in COMPRESSED
                entry.compress_type = zipfile.ZIP_STORED if compressed else zipfile.ZIP_DEFLATED
                with path.open("rb") as source, archive.open(entry, "w", force_zip64=True) as target:
                    shutil.copyfileobj(source, target)
    except OSError as error:
        stream.close()
        raise BundleUnreadable(f"{error.filename or name} cannot be read: {error.strerror}") from error
    stream.seek(0)
    return Upload(stream, f"{name}.zip", "application/zip")


def open_file(path: str | Path) -> Upload:
    """One file as it is, ready to be sent. Raises BundleUnreadable where there is none, or nothing in it."""
    source = Path(path).expanduser()
    if not source.is_file():
        raise BundleUnreadable(f"no scene at {source}: neither a folder nor a file")
    if source.stat().st_size == 0:
        raise BundleUnreadable(f"{source} is empty")
    try:
        stream = source.open("rb")
    except OSError as error:
        raise BundleUnreadable(f"{source} cannot be read: {error.strerror}") from error
    return Upload(stream, source.name, MEDIA_TYPES.get(source.suffix.lower(), "application/octet-stream"))


def picture_at(path: str | Path) -> tuple[PictureName, Upload]:
    """What the file beside a scene is, by its ending, and the open file. Raises BundleUnreadable."""
    suffix = Path(path).suffix.lower()
    if suffix not in PICTURES:
        known = ", ".join(f"{ending} ({name})" for ending, name in PICTURES.items())
        raise BundleUnreadable(f"{path} ends in {suffix!r}; the pictures of a scene are {known}")
    return PICTURES[suffix], open_file(path)


def _pack_folder(folder: Path) -> Upload:
    missing = [name for name in BUNDLE_FILES if not (folder / name).is_file()]
    if missing:
        present = sorted(entry.name for entry in folder.iterdir())
        shown = ", ".join(present[:8]) + (f" and {len(present) - 8} more" if len(present) > 8 else "")
        pictures = pictures_among((path.name for path in folder.rglob("*")), str(folder))
        raise BundleUnreadable(
            f"{folder} lacks {' and '.join(missing)} (it holds {shown or 'nothing'}); "
            f"{pictures or 'a recording of another program is given by its file'}"
        )
    stream = tempfile.SpooledTemporaryFile(max_size=SPOOL_LIMIT_BYTES)  # noqa: SIM115 (the upload closes it)
    try:
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
            for name in (*BUNDLE_FILES, *_meshes(folder)):
                entry = zipfile.ZipInfo(name, ZIP_EPOCH)
                entry.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(entry, (folder / name).read_bytes())
    except OSError as error:
        stream.close()
        raise BundleUnreadable(f"{folder} cannot be read: {error.strerror}") from error
    stream.seek(0)
    return Upload(stream, f"{folder.resolve().name}.zip", "application/zip")


def _meshes(folder: Path) -> list[str]:
    """Mesh files of colliders anywhere below the folder, by their path in it."""
    files = (path for path in folder.rglob("*") if path.suffix.lower() in MESH_SUFFIXES and path.is_file())
    return sorted(path.relative_to(folder).as_posix() for path in files)
