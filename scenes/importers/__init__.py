"""Imports of scenes: our bundle, PhysTwin's pickle, tables of markers, told apart by their content.

A new one is a file beside this one and a line here.
"""

from __future__ import annotations

from pathlib import PurePosixPath

from physworld.scene import Scene
from physworld_scenes.archives import is_tar, is_zip
from physworld_scenes.bundle import bundle_from_bytes
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers import film, phystwin, pictures
from physworld_scenes.importers.options import FolderImporter, Importer, ImportOptions, Looked
from physworld_scenes.importers.tables.forms import FORMS, NPZ, PLAIN
from physworld_schemas.base import FieldError

__all__ = [
    "FOLDERS",
    "IMPORTERS",
    "FolderImporter",
    "ImportOptions",
    "Importer",
    "import_any",
    "importer_of",
    "look_at",
]

BUNDLE = Importer(
    "bundle",
    "archive of scene.json and scene.npz",
    (".zip", ".tar", ".tar.gz", ".tgz"),
    "the scene as it is declared, and meshes of its colliders; the SDK and the command line pack folders",
    lambda data, filename: is_zip(data) or is_tar(data),
    lambda data, name, options: bundle_from_bytes(data),
)
IMPORTERS = (NPZ, BUNDLE, *FORMS, phystwin.IMPORTER, PLAIN)
"""The first that recognises a file reads it."""
FOLDERS = (pictures.IMPORTER, film.IMPORTER)
"""Forms that are folders or films: trackings (``physworld_scenes.importers.unpacked``) and ``physworld import`` read
them."""


def import_any(
    data: bytes, filename: str = "", options: ImportOptions | None = None
) -> tuple[Scene, list[str]]:
    """The scene in an uploaded file, and its warnings. The content decides, not the file's name.

    Args:
        data: the file.
        filename: gives the scene its name where the file has none.
        options: what the file does not say (kind, controllers, the axis that points up).

    Raises:
        SceneInvalid: with every fault.
    """
    path = PurePosixPath(filename.replace("\\", "/"))
    return importer_of(data, path.name, options).read(data, path.stem or "scene", options)


def look_at(data: bytes, filename: str = "", options: ImportOptions | None = None) -> tuple[str, Looked]:
    """The form's title, and what an import would guess.

    Args:
        data, filename, options: as of ``import_any``.

    Raises:
        SceneInvalid: with every fault, missing facts of the body excepted.
    """
    path = PurePosixPath(filename.replace("\\", "/"))
    importer = importer_of(data, path.name, options)
    look = importer.look
    return importer.title, Looked() if look is None else look(data, path.stem or "scene", options)


def importer_of(data: bytes, name: str = "", options: ImportOptions | None = None) -> Importer:
    """The importer that reads a file: the one that the options name, else the first that recognises it.

    Raises:
        SceneInvalid: there is none.
    """
    if options is not None and options.importer is not None:
        wanted = next((one for one in IMPORTERS if one.name == options.importer), None)
        if wanted is None:
            known = ", ".join(importer.name for importer in IMPORTERS)
            raise SceneInvalid(
                [FieldError(loc=["importer"], msg=f"is {options.importer!r}; known are {known}")]
            )
        return wanted
    for importer in IMPORTERS:
        if importer.recognises(data, name):
            return importer
    if film.begins_as_film(data):
        message = "is a film: `POST /v1/trackings` and `physworld import` make a scene of it"
        raise SceneInvalid([FieldError(loc=[name or "file"], msg=message)])
    start = data[:8].hex(" ") or "nothing"
    forms = ", nor ".join(importer.title for importer in IMPORTERS)
    message = f"is neither {forms}: {len(data)} bytes that begin with {start}"
    raise SceneInvalid([FieldError(loc=[name or "file"], msg=message)])
