"""Imports of scenes: our bundle, PhysTwin's pickle, C3D motion capture, told apart by their content.

A new one is a file beside this one and a line here.
"""

from __future__ import annotations

from pathlib import PurePosixPath

from physworld.scene import Scene
from physworld_scenes.archives import is_tar, is_zip
from physworld_scenes.bundle import bundle_from_bytes
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers import c3d, phystwin, pictures
from physworld_scenes.importers.options import FolderImporter, Importer, ImportOptions
from physworld_schemas.base import FieldError

__all__ = ["FOLDERS", "IMPORTERS", "FolderImporter", "ImportOptions", "Importer", "import_any"]

BUNDLE = Importer(
    "bundle",
    "archive of scene.json and scene.npz",
    (".zip", ".tar", ".tar.gz", ".tgz"),
    "the scene as it is declared, and meshes of its colliders; the SDK and the command line pack folders",
    lambda data, filename: is_zip(data) or is_tar(data),
    lambda data, name, options: bundle_from_bytes(data),
)
IMPORTERS = (BUNDLE, c3d.IMPORTER, phystwin.IMPORTER)
FOLDERS = (pictures.IMPORTER,)
"""Forms that are folders: the command ``physworld import`` reads them, the service does not."""


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
    for importer in IMPORTERS:
        if importer.recognises(data, path.name):
            return importer.read(data, path.stem or "scene", options)
    start = data[:8].hex(" ") or "nothing"
    forms = ", nor ".join(importer.title for importer in IMPORTERS)
    message = f"is neither {forms}: {len(data)} bytes that begin with {start}"
    raise SceneInvalid([FieldError(loc=[path.name or "file"], msg=message)])
