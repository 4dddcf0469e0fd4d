"""Folders of pictures with depth: which files there are, how they are calibrated, one frame at a time.

- several cameras (PhysTwin): ``color/CAMERA/FRAME.png`` or ``color/CAMERA.mp4``; ``depth/CAMERA/FRAME.npy`` or
  ``.png``.
- one camera (Open3D): ``color/FRAME.jpg`` or ``.png``; ``depth/FRAME.png``.

``color`` may be called ``rgb`` or ``image``. The calibration is in :mod:`physworld_scenes.importers.calibration`,
tracks of another tracker in :mod:`physworld_scenes.importers.given_tracks`. Whole numbers of depth are millimetres
unless ``depth_scale`` says otherwise, others metres. Every picture's size is known before it is decoded, and is the
same in all of a camera.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from physworld.arrays import Array
from physworld.camera import MOST_PIXELS, Camera
from physworld.tracking.view import View
from physworld_scenes.archives import ArchiveRefused, parse_array
from physworld_scenes.errors import refused
from physworld_scenes.importers.calibration import Calibration, calibration_of
from physworld_scenes.importers.options import FolderImporter

COLOUR_FOLDERS, DEPTH_FOLDERS = ("color", "colour", "rgb", "image"), ("depth",)
PICTURES, FILMS, ARRAYS = (".png", ".jpg", ".jpeg"), (".mp4", ".mkv", ".avi"), (".npy",)
MOST_CAMERAS, MOST_FRAMES = 16, 20_000
MOST_FILE_BYTES = 256 << 20
MOST_FILM_BYTES = 1 << 30
"""Of a film, decoded."""
MILLIMETRES = 1000.0
FARTHEST_M = 1000.0
"""Depth beyond it is none."""


@dataclass(frozen=True)
class Pictures:
    """A folder's recording.

    Attributes:
        views: the cameras.
        names: of their folders; "0" where there is none.
        kept: numbers of the frames that are read, of all that there are.
        recorded: how many there are.
        fps: frames per second, or None.
        placed: whether the cameras' places in the world are known; else each is at the origin.
        layout: which it is, for people.
    """

    views: list[View]
    names: list[str]
    kept: list[int]
    recorded: int
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
    colours, depths, calibration = _parts(folder)
    films = [_film(files[0]) if files[0].suffix.lower() in FILMS else None for files in colours.values()]
    counts = [
        len(files) if film is None else len(film) for film, files in zip(films, colours.values(), strict=True)
    ]
    for number, (count, depth) in enumerate(zip(counts, depths.values(), strict=True)):
        if count != len(depth):
            raise refused("depth", f"camera {number} has {len(depth)} frames of depth and {count} of colour")
    if len(set(counts)) > 1:
        raise refused("color", f"cameras have {counts} frames; they must be alike")
    kept = list(range(counts[0]))[frames or slice(None)]
    if len(kept) < 2:
        raise refused("color", f"{len(kept)} of {counts[0]} frames are read; a motion needs 2 or more")
    views = [
        _view(number, (film, seen, measured), calibration, depth_scale, kept)
        for number, (film, seen, measured) in enumerate(
            zip(films, colours.values(), depths.values(), strict=True)
        )
    ]
    placed = calibration.poses is not None
    return Pictures(views, list(colours), kept, counts[0], calibration.fps, placed, calibration.layout)


def read_first(folder: Path, depth_scale: float | None = None, most_pixels: int = MOST_PIXELS) -> Pictures:
    """The first frame alone, without a look at the others.

    Args:
        folder: one of the layouts.
        depth_scale: depth values a metre; None: 1000 of whole numbers, 1 of others.
        most_pixels: of all cameras' pictures.

    Raises:
        SceneInvalid: with what is missing, damaged or too large.
    """
    colours, depths, calibration = _parts(folder)
    views: list[View] = []
    pixels = 0
    for number, (files, depth) in enumerate(zip(colours.values(), depths.values(), strict=True)):
        film = _film(files[0], 1) if files[0].suffix.lower() in FILMS else None
        width, height = size_of(files[0]) if film is None else film[0].shape[1::-1]
        pixels += width * height
        if pixels > most_pixels:
            raise refused(
                "color", f"has {pixels} pixels in {number + 1} cameras, at most {most_pixels} are shown"
            )
        views.append(_view(number, (film, files, depth), calibration, depth_scale, [0]))
    placed = calibration.poses is not None
    return Pictures(views, list(colours), [0], 1, calibration.fps, placed, calibration.layout)


def _parts(folder: Path) -> tuple[dict[str, list[Path]], dict[str, list[Path]], Calibration]:
    """Files of colour and of depth by camera, and how the cameras are calibrated."""
    colour_root, depth_root = _part(folder, COLOUR_FOLDERS), _part(folder, DEPTH_FOLDERS)
    if colour_root is None or depth_root is None:
        raise refused(folder.name, "holds no folder color beside a folder depth")
    colours, depths = cameras_in(colour_root), cameras_in(depth_root)
    if len(colours) != len(depths) or (len(colours) > 1 and list(colours) != list(depths)):
        raise refused(
            "depth",
            f"{len(depths)} cameras have depth ({', '.join(depths)}), "
            f"{len(colours)} have colours ({', '.join(colours)})",
        )
    return colours, depths, calibration_of(folder, list(colours))


def _view(
    number: int,
    files: tuple[list[Array] | None, list[Path], list[Path]],
    calibration: Calibration,
    depth_scale: float | None,
    kept: list[int],
) -> View:
    """One camera.

    Args:
        number: its own.
        files: its film or None, its pictures, its depth.
        calibration: of all.
        depth_scale: depth values a metre, or None.
        kept: numbers of the frames that are read.
    """
    film, colour, depth = files
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


def colours_of(folder: Path) -> Path:
    """The folder with the colours of a folder of pictures. Raises SceneInvalid."""
    root = _part(folder, COLOUR_FOLDERS)
    if root is None:
        raise refused(folder.name, "holds no folder color")
    return root


def cameras_in(root: Path) -> dict[str, list[Path]]:
    """Files of every camera by its name, in the order of their numbers: subfolders, films, or the folder itself."""
    entries = sorted(root.iterdir(), key=_natural)
    folders = [entry for entry in entries if entry.is_dir()]
    films = [entry for entry in entries if entry.suffix.lower() in FILMS]
    if len(folders or films) > MOST_CAMERAS:
        raise refused(root.name, f"{len(folders or films)} cameras, at most {MOST_CAMERAS} are read")
    if folders:
        return {entry.name: frames_in(entry) for entry in folders}
    return {film.stem: [film] for film in films} or {"0": frames_in(root)}


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
    return [
        (int(part), "") if part.isdecimal() and len(part) < 19 else (-1, part) for part in parts
    ], path.name


def size_of(path: Path, content: bytes | None = None) -> tuple[int, int]:
    """Width and height of a picture, from its head, which is read from the file where there is no content."""
    from PIL import Image

    try:
        source = path if content is None else io.BytesIO(content)
        with Image.open(source, formats=("PNG", "JPEG")) as picture:
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
    content = path.read_bytes()
    width, height = size_of(path, content)
    if (height, width) != shape:
        raise refused(path.name, f"has {width} x {height} pixels, the first picture {shape[1]} x {shape[0]}")
    try:
        with Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as picture:
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
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        metres = values.astype(np.float32) / np.float32(scale or (MILLIMETRES if whole else 1.0))
    metres[~((metres >= 0.0) & (metres <= FARTHEST_M))] = 0.0
    return metres


def _film(path: Path, most: int | None = None) -> list[Array]:
    """All frames of a film, or the first ones, within the limit."""
    import av

    frames: list[Array] = []
    total = 0
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            if stream.width * stream.height > MOST_PIXELS:
                raise refused(path.name, f"has {stream.width} x {stream.height} pixels")
            for frame in container.decode(stream):
                if len(frames) == most:
                    break
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


IMPORTER = FolderImporter(
    "rgbd",
    "folder of pictures with depth",
    (),
    "one or several calibrated cameras, PhysTwin's or Open3D's layout; what is in a box is "
    "followed, or tracks/CAMERA.npz of another tracker is taken: `physworld import`, `POST /v1/trackings`",
    is_pictures,
)
