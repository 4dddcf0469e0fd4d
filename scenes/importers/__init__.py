"""Imports of scenes: our bundle, PhysTwin's pickle, C3D motion capture, told apart by their content."""

from __future__ import annotations

from pathlib import PurePosixPath

from physworld.scene import Scene
from physworld_scenes.archives import is_tar, is_zip
from physworld_scenes.bundle import bundle_from_bytes
from physworld_scenes.importers import c3d, phystwin
from physworld_scenes.importers.options import ImportOptions
from physworld_schemas.base import FieldError
from physworld_storage.errors import SceneInvalid

__all__ = ["ImportOptions", "import_any"]

PICKLE_PROTOCOL = b"\x80"
PICKLE_SUFFIXES = (".pkl", ".pickle")


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
    name = path.stem or "scene"
    if is_zip(data) or is_tar(data):
        return bundle_from_bytes(data)
    if c3d.is_c3d(data):
        return c3d.read_bytes(data, name, options)
    if data[:1] == PICKLE_PROTOCOL or path.suffix.lower() in PICKLE_SUFFIXES:
        return phystwin.read_bytes(data, name, options)
    start = data[:8].hex(" ") or "nothing"
    message = (
        f"is neither an archive with scene.json and scene.npz, nor PhysTwin's final_data.pkl, nor C3D:"
        f" {len(data)} bytes that begin with {start}"
    )
    raise SceneInvalid([FieldError(loc=[path.name or "file"], msg=message)])
