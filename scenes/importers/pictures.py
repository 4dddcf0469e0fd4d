"""Folders of pictures with depth: which files there are, how they are calibrated, one frame at a time.

- PhysTwin: ``color/CAMERA/FRAME.png`` or ``color/CAMERA.mp4``; ``depth/CAMERA/FRAME.npy`` or ``.png``;
  ``metadata.json`` (``intrinsics``, ``fps``); ``calibrate.pkl`` or ``.json``, camera to world of each camera.
- Open3D: ``color/FRAME.jpg`` or ``.png``; ``depth/FRAME.png``; ``camera_intrinsic.json`` (its matrix by columns).
- plain: either order of files, and ``cameras.json``: a list of ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy``
  and ``world_to_camera`` (absent: not calibrated), the form of ``physworld video --camera``.

``color`` may be called ``rgb`` or ``image``. Whole numbers of depth are millimetres unless ``depth_scale`` says
otherwise, others metres. Every picture's size is known before it is decoded, and is the same in all of a camera.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.camera import MOST_PIXELS, Camera
from physworld.tracking.view import View
from physworld_scenes.archives import ArchiveRefused, parse_array
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers.array_pickle import PickleRefused, load_arrays
from physworld_scenes.importers.options import FolderImporter
from physworld_schemas.base import FieldError
from physworld_schemas.wording import reason

COLOUR_FOLDERS, DEPTH_FOLDERS = ("color", "colour", "rgb", "image"), ("depth",)
PICTURES, FILMS, ARRAYS = (".png", ".jpg", ".jpeg"), (".mp4", ".mkv", ".avi"), (".npy",)
INTRINSICS = ("camera_intrinsic.json", "intrinsic.json", "intrinsics.json")
MOST_CAMERAS, MOST_FRAMES = 16, 20_000
MOST_TEXT_BYTES = 1 << 20
MOST_FILE_BYTES = 256 << 20
MOST_FILM_BYTES = 1 << 30
"""Of a film, decoded."""
MILLIMETRES = 1000.0


@dataclass(frozen=True)
class Pictures:
    """A folder's recording.

    Attributes:
        views: the cameras.
        fps: frames per second, or None.
        placed: whether the cameras' places in the world are known; else each is at the origin.
        layout: which it is, for people.
    """

    views: list[View]
    fps: float | None
    placed: bool
    layout: str


def is_pictures(folder: Path) -> bool:
    """Whether a folder holds colours and depth."""
    return folder.is_dir() and all(
        _part(folder, names) is not None for names in (COLOUR_FOLDERS, DEPTH_FOLDERS)
    )


def read_pictures(folder: Path, depth_scale: float | None = None, frames: slice | None = None) -> Pictures:
    """The recording in a folder.

    Args:
        folder: one of the layouts.
        depth_scale: depth values a metre; None: 1000 of whole numbers, 1 of others.
        frames: which of them; None: all.

    Raises:
        SceneInvalid: with what is missing, damaged or too large.
    """
    colour_root, depth_root = _part(folder, COLOUR_FOLDERS), _part(folder, DEPTH_FOLDERS)
    if colour_root is None or depth_root is None:
        raise refused(folder.name, "holds no folder color beside a folder depth")
    colours, depths = _cameras_in(colour_root), _cameras_in(depth_root)
    if len(colours) != len(depths):
        raise refused("depth", f"{len(depths)} cameras have depth, {len(colours)} have colours")
    calibration = _calibration(folder, len(colours))
    views = []
    for number, (colour, depth) in enumerate(zip(colours, depths, strict=True)):
        views.append(_view(number, colour, depth, calibration, depth_scale, frames))
    if len({view.frames for view in views}) > 1:
        raise refused("color", f"cameras have {[view.frames for view in views]} frames; they must be alike")
    return Pictures(views, calibration.fps, calibration.poses is not None, calibration.layout)


def refused(where: str, message: str) -> SceneInvalid:
    """The error of one fault at one place."""
    return SceneInvalid([FieldError(loc=[where], msg=message)])


@dataclass(frozen=True)
class _Calibration:
    """Intrinsic matrices (3, 3), camera to world (4, 4) or None, what else the files say."""

    matrices: list[Array]
    poses: list[Array] | None
    fps: float | None
    layout: str


def _view(
    number: int,
    colour: list[Path],
    depth: list[Path],
    calibration: _Calibration,
    depth_scale: float | None,
    frames: slice | None,
) -> View:
    film = _film(colour[0]) if colour[0].suffix.lower() in FILMS else None
    count = len(film) if film is not None else len(colour)
    if count != len(depth):
        raise refused("depth", f"camera {number} has {len(depth)} frames of depth and {count} of colour")
    kept = list(range(count))[frames or slice(None)]
    if len(kept) < 2:
        raise refused("color", f"camera {number} has {len(kept)} frames; a motion needs 2 or more")
    height, width = film[0].shape[:2] if film is not None else size_of(colour[0])[::-1]
    pose = np.eye(4) if calibration.poses is None else np.linalg.inv(calibration.poses[number])
    matrix = calibration.matrices[number]
    try:
        camera = Camera(width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], pose)
    except ValueError as error:
        raise refused("cameras", f"camera {number}: {error}") from error

    def colours(frame: int) -> Array:
        return film[kept[frame]] if film is not None else _colours(colour[kept[frame]], (height, width))

    def depths(frame: int) -> Array:
        return _depth(depth[kept[frame]], (height, width), depth_scale)

    colours(0), depths(0)
    return View(camera, colours, depths, len(kept))


def _part(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_dir()), None)


def _cameras_in(root: Path) -> list[list[Path]]:
    """Files of every camera, in the order of their numbers: subfolders, films, or the folder itself."""
    entries = sorted(root.iterdir(), key=_natural)
    folders = [entry for entry in entries if entry.is_dir()]
    films = [entry for entry in entries if entry.suffix.lower() in FILMS]
    cameras = (
        [frames_in(entry) for entry in folders]
        if folders
        else [[film] for film in films]
        if films
        else [frames_in(root)]
    )
    if len(cameras) > MOST_CAMERAS:
        raise refused(root.name, f"{len(cameras)} cameras, at most {MOST_CAMERAS} are read")
    return cameras


def frames_in(folder: Path) -> list[Path]:
    files = [path for path in folder.iterdir() if path.suffix.lower() in PICTURES + ARRAYS and path.is_file()]
    kinds = sorted({path.suffix.lower() for path in files})
    if not files or len(files) > MOST_FRAMES:
        raise refused(folder.name, f"holds {len(files)} pictures; 1 to {MOST_FRAMES} are read")
    if len(kinds) > 1:  # PhysTwin keeps depth as arrays and, for people, as pictures
        files = [path for path in files if path.suffix.lower() == (".npy" if ".npy" in kinds else ".png")]
    return sorted(files, key=_natural)


def _natural(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Order of names by the numbers in them: 2 before 10."""
    parts = re.findall(r"\d+|\D+", path.stem)
    return [(int(part), "") if part.isdigit() and len(part) < 19 else (-1, part) for part in parts], path.name


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of a picture, from its head."""
    from PIL import Image

    try:
        with Image.open(path, formats=("PNG", "JPEG")) as picture:
            size = picture.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise refused(path.name, f"is no picture: {str(error)[:160]}") from error
    if min(size) < 16 or size[0] * size[1] > MOST_PIXELS:
        raise refused(
            path.name, f"has {size[0]} x {size[1]} pixels; 16 a side to {MOST_PIXELS} in all are read"
        )
    return size


def picture_of(path: Path, shape: tuple[int, int], mode: str | None) -> Array:
    from PIL import Image

    if path.stat().st_size > MOST_FILE_BYTES:
        raise refused(path.name, f"has {path.stat().st_size} bytes, at most {MOST_FILE_BYTES} are read")
    width, height = size_of(path)
    if (height, width) != shape:
        raise refused(path.name, f"has {width} x {height} pixels, the first picture {shape[1]} x {shape[0]}")
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as picture:
            if mode is None and picture.mode not in ("I;16", "I;16B", "I", "L", "F"):
                raise refused(path.name, f"is a picture of colours ({picture.mode}), not of depth")
            return np.asarray(picture if mode is None else picture.convert(mode))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise refused(path.name, f"is damaged: {str(error)[:160]}") from error


def _colours(path: Path, shape: tuple[int, int]) -> Array:
    return picture_of(path, shape, "RGB")


def _depth(path: Path, shape: tuple[int, int], scale: float | None) -> Array:
    """Depth (H, W) float32 [m], 0 where there is none."""
    if path.suffix.lower() == ".npy":
        if path.stat().st_size > MOST_FILE_BYTES:
            raise refused(path.name, f"has {path.stat().st_size} bytes, at most {MOST_FILE_BYTES} are read")
        try:
            values = parse_array(path.name, path.read_bytes())
        except ArchiveRefused as error:
            raise refused(path.name, str(error)) from error
    else:
        values = picture_of(path, shape, None)
    if values.shape != shape:
        raise refused(path.name, f"has shape {values.shape}, colours have {shape}")
    whole = values.dtype.kind in "iu"
    metres = values.astype(np.float32) / np.float32(scale or (MILLIMETRES if whole else 1.0))
    metres[~np.isfinite(metres) | (metres < 0.0)] = 0.0
    return metres


def _film(path: Path) -> list[Array]:
    """All frames of a film, within the limit."""
    import av

    frames: list[Array] = []
    total = 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            if stream.width * stream.height > MOST_PIXELS:
                raise refused(path.name, f"has {stream.width} x {stream.height} pixels")
            for frame in container.decode(stream):
                frames.append(frame.to_ndarray(format="rgb24"))
                total += frames[-1].nbytes
                if total > MOST_FILM_BYTES:
                    raise refused(
                        path.name, f"has more than {MOST_FILM_BYTES} bytes of frames; give pictures"
                    )
    except (av.FFmpegError, OSError, IndexError, ValueError) as error:
        raise refused(path.name, f"is no film: {str(error)[:160]}") from error
    if not frames:
        raise refused(path.name, "holds no frame")
    return frames


def _calibration(folder: Path, cameras: int) -> _Calibration:
    if (folder / "cameras.json").is_file():
        return _plain(_json(folder / "cameras.json"), cameras)
    if (folder / "metadata.json").is_file():
        return _phystwin(folder, cameras)
    for name in INTRINSICS:
        if (folder / name).is_file():
            return _open3d(_json(folder / name), name, cameras)
    raise refused(
        folder.name,
        f"says nothing of its lens: neither cameras.json, metadata.json nor {', '.join(INTRINSICS)}",
    )


def _plain(content: Any, cameras: int) -> _Calibration:
    facts = _expect("cameras.json", lambda: [dict(camera) for camera in content])
    if len(facts) != cameras:
        raise refused("cameras.json", f"describes {len(facts)} cameras, there are {cameras}")
    matrices = _expect(
        "cameras.json",
        lambda: [
            np.array([[f["fx"], 0.0, f["cx"]], [0.0, f["fy"], f["cy"]], [0.0, 0.0, 1.0]], dtype=float)
            for f in facts
        ],
    )
    placed = ["world_to_camera" in f for f in facts]
    if any(placed) != all(placed) or (len(facts) > 1 and not all(placed)):
        raise refused("cameras.json", "gives world_to_camera of some cameras only; several cameras need all")
    poses = (
        _expect("cameras.json", lambda: [np.linalg.inv(_matrix(f["world_to_camera"], 4)) for f in facts])
        if all(placed)
        else None
    )
    return _Calibration(matrices, poses, None, "plain")


def _phystwin(folder: Path, cameras: int) -> _Calibration:
    facts = _json(folder / "metadata.json")
    matrices = _expect("metadata.json", lambda: [_matrix(m, 3) for m in facts["intrinsics"]])
    fps = _expect("metadata.json", lambda: None if facts.get("fps") is None else float(facts["fps"]))
    poses = None
    if (folder / "calibrate.json").is_file():
        listed = _json(folder / "calibrate.json")
        poses = _expect("calibrate.json", lambda: [_matrix(m, 4) for m in listed])
    elif (folder / "calibrate.pkl").is_file():
        try:
            listed = load_arrays(_bytes(folder / "calibrate.pkl"))
        except PickleRefused as error:
            raise refused("calibrate.pkl", str(error)) from error
        poses = _expect("calibrate.pkl", lambda: [_matrix(m, 4) for m in listed])
    if len(matrices) != cameras or (poses is not None and len(poses) != cameras):
        told = f"{len(matrices)} intrinsics and {len(poses) if poses is not None else 'no'} poses"
        raise refused("metadata.json", f"there are {cameras} cameras, but {told}")
    if poses is None and cameras > 1:
        raise refused("calibrate.pkl", f"is missing: {cameras} cameras need their places")
    return _Calibration(matrices, poses, fps, "PhysTwin")


def _open3d(content: Any, name: str, cameras: int) -> _Calibration:
    if cameras != 1:
        raise refused(name, f"describes one camera, there are {cameras}")
    matrix = _expect(name, lambda: _matrix(np.reshape(content["intrinsic_matrix"], (3, 3)).T, 3))
    return _Calibration([matrix], None, None, "Open3D")


def _matrix(values: Any, size: int) -> Array:
    matrix = np.array(values, dtype=np.float64)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
        raise ValueError(f"a matrix of shape {matrix.shape}, not an invertible one of {size} x {size}")
    return matrix


def _expect(name: str, read: Callable[[], Any]) -> Any:
    """What ``read`` gives, or the refusal of the file where it stumbles over its content."""
    try:
        return read()
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, np.linalg.LinAlgError) as error:
        raise refused(name, f"is not of its form: {reason(error)[:160]}") from error


def _json(path: Path) -> Any:
    try:
        return json.load(io.BytesIO(_bytes(path)))
    except (ValueError, RecursionError) as error:
        raise refused(path.name, f"is no JSON: {str(error)[:160]}") from error


def _bytes(path: Path) -> bytes:
    if path.stat().st_size > MOST_TEXT_BYTES:
        raise refused(path.name, f"has {path.stat().st_size} bytes, at most {MOST_TEXT_BYTES} are read")
    return path.read_bytes()


IMPORTER = FolderImporter(
    "rgbd",
    "folder of pictures with depth",
    (),
    "one or several calibrated cameras, PhysTwin's or Open3D's layout; what is in a box is "
    "followed: by `physworld import` alone",
    is_pictures,
)
