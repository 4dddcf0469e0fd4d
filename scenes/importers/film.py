"""Films and folders of pictures of one colour camera, one frame at a time.

A film is decoded in the order in which frames are asked for, and again from its beginning where an earlier one is
asked for: it is never held as a whole. Its moments are those of its frames, which need not be evenly spread. What
decodes films and straightens pictures is imported where it is used: whoever only tells forms of files apart, as the
service does, need not have it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.camera import MOST_PIXELS, USUAL_FOCAL, Camera
from physworld.tracking.view import View, from_opencv, to_opencv
from physworld_scenes.errors import refused
from physworld_scenes.importers.options import FolderImporter
from physworld_scenes.importers.pictures import (
    FILMS,
    MOST_FRAMES,
    PICTURES,
    frames_in,
    is_pictures,
    picture_of,
    size_of,
)
from physworld_schemas.wording import reason

HEADS = ((4, b"ftyp"), (0, b"\x1a\x45\xdf\xa3"), (8, b"AVI "))
"""Where and how MP4, Matroska and AVI begin."""
COMPLETE = 0.95
"""Share of the frames that a film declares, below which it was cut short: some lists of edits drop a few."""
LENS = ("width", "height", "fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class Filmed:
    """A recording of one colour camera.

    Attributes:
        view: pictures without the lens' distortion; the camera at the origin, no depth.
        first: picture as it was taken, (H, W, 3) uint8.
        times: of the frames since the first [s], (T,), or None: the pictures do not say.
        lens_known: whether the focal length is a given one.
        matrix: with which it took its pictures, (3, 3), OpenCV's pixels.
        distortion: OpenCV's coefficients; none: ().
    """

    view: View
    first: Array
    times: Array | None
    lens_known: bool
    matrix: Array
    distortion: tuple[float, ...]

    def straight(self, pixels: Array) -> Array:
        """Where pixels (P, 2) of the pictures as they were taken lie in those of ``view``."""
        if not self.distortion:
            return pixels
        import cv2

        places = np.reshape(to_opencv(pixels), (-1, 1, 2)).astype(np.float64)
        moved = cv2.undistortPoints(places, self.matrix, np.array(self.distortion), None, self.matrix)
        return from_opencv(moved[:, 0])

    def straight_mask(self, mask: Array) -> Array:
        """A mask (H, W) of a picture as it was taken, in those of ``view``."""
        return _straightened(mask.astype(np.uint8) * 255, self.matrix, self.distortion) > 127


def is_film(path: Path) -> bool:
    """Whether a file is a film, by its beginning, or a folder one of pictures without depth."""
    if path.is_dir():
        others = is_pictures(path) or (path / "scene.json").is_file()
        return not others and any(
            entry.suffix.lower() in PICTURES + FILMS for entry in path.iterdir() if entry.is_file()
        )
    with path.open("rb") as stream:
        return begins_as_film(stream.read(16))


def begins_as_film(data: bytes) -> bool:
    """Whether bytes are the beginning of a film."""
    return any(data[at : at + len(mark)] == mark for at, mark in HEADS)


def read_film(path: Path, lens: Path | None = None, frames: slice | None = None) -> Filmed:
    """The recording in a film or a folder of pictures.

    Args:
        path: of it; a folder may hold one film.
        lens: JSON with width, height, fx, fy, cx, cy [px], perhaps distortion (OpenCV's coefficients); None: unknown.
        frames: which of them; None: all.

    Raises:
        SceneInvalid: with what is missing, damaged, cut short or too large.
    """
    film = path
    if path.is_dir():
        films = [entry for entry in sorted(path.iterdir()) if entry.suffix.lower() in FILMS]
        if len(films) > 1:
            raise refused(path.name, f"holds {len(films)} films: one camera is read; name one of them")
        film = films[0] if films else path
    frames = frames or slice(None)
    if film.is_dir():
        files = frames_in(film)
        width, height = size_of(files[0])
        files = _at_least_two(film.name, files, frames)
        times = None

        def taken(frame: int) -> Array:
            return picture_of(files[frame], (height, width), "RGB")

        count = len(files)
    else:
        decoded = _Film(film)
        width, height = decoded.size
        kept = _at_least_two(film.name, decoded.complete(frames), frames)
        times = decoded.times[kept] - decoded.times[kept[0]]
        count = len(kept)

        def taken(frame: int) -> Array:
            return decoded.frame(kept[frame])

    camera, distortion = _camera(lens, width, height)
    matrix = np.array([[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]])
    view = View(
        camera,
        lambda frame: _straightened(taken(frame), matrix, distortion),
        lambda frame: np.zeros((height, width), dtype=np.float32),
        count,
    )
    return Filmed(view, taken(0), times, lens is not None, matrix, distortion)


def _at_least_two(name: str, all_of_them: list[Any], frames: slice) -> list[Any]:
    kept = all_of_them[frames]
    if len(kept) < 2:
        raise refused(
            name, f"{len(kept)} of its {len(all_of_them)} frames are left; a motion needs 2 or more"
        )
    return kept


def _straightened(picture: Array, matrix: Array, distortion: tuple[float, ...]) -> Array:
    if not distortion:
        return picture
    import cv2

    return np.asarray(cv2.undistort(picture, matrix, np.array(distortion)))


class _Film:
    """One film, decoded forwards."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._fault: str | None = None
        self.size, times, self._declared = self._scan()
        self.times = np.array(times)
        self._decoding: Iterator[Array] | None = None
        self._number, self._last = -1, np.zeros((0, 0, 3), dtype=np.uint8)

    def complete(self, frames: slice) -> list[int]:
        """Numbers of its frames, unless it ends early and what it lacks is wanted."""
        count = len(self.times)
        wanted_to_the_end = frames.stop is None or frames.stop > count
        if wanted_to_the_end and (self._fault or count < COMPLETE * self._declared):
            said = f" of {self._declared} that it declares" if self._declared > count else ""
            why = f": {self._fault}" if self._fault else ""
            raise refused(
                self._path.name,
                f"is cut short: {count} frames can be read{said}{why}; frames 0:{count} are whole",
            )
        if (np.diff(self.times) <= 0).any():
            raise refused(self._path.name, "holds frames that do not follow one another in time")
        return list(range(count))

    def frame(self, number: int) -> Array:
        """Colours (H, W, 3) uint8 of a frame."""
        if number < self._number or self._decoding is None:
            self._decoding, self._number = self._decoded(), -1
        while self._number < number:
            self._last = next(self._decoding)
            self._number += 1
        return self._last

    def _decoded(self) -> Iterator[Array]:
        import av

        with av.open(str(self._path)) as container:
            for frame in container.decode(video=0):
                picture = frame.to_ndarray(format="rgb24")
                yield np.ascontiguousarray(np.rot90(picture, frame.rotation // 90))

    def _scan(self) -> tuple[tuple[int, int], list[float], int]:
        """Width and height as shown, the frames' moments [s], how many frames the film declares."""
        import av

        times: list[float] = []
        width = height = declared = 0
        try:
            with av.open(str(self._path)) as container:
                stream = container.streams.video[0]
                stream.thread_type = "AUTO"
                declared = stream.frames
                if not 0 < stream.width * stream.height <= MOST_PIXELS or declared > MOST_FRAMES:
                    raise refused(
                        self._path.name,
                        f"has {declared} frames of {stream.width} x {stream.height} pixels; at most {MOST_FRAMES} "
                        f"of {MOST_PIXELS} are read",
                    )
                rate = float(stream.average_rate or 0.0)
                for frame in container.decode(stream):
                    if not times:
                        turned = frame.rotation % 180 != 0
                        width, height = (frame.height, frame.width) if turned else (frame.width, frame.height)
                    if frame.time is None and not rate:
                        raise refused(self._path.name, "says neither when its frames are nor their rate")
                    times.append(frame.time if frame.time is not None else len(times) / rate)
                    if len(times) > MOST_FRAMES:
                        raise refused(self._path.name, f"has more than {MOST_FRAMES} frames")
        except (av.FFmpegError, OSError, IndexError, ValueError) as error:
            if not times:
                raise refused(self._path.name, f"is no film: {str(error)[:160]}") from error
            self._fault = str(error)[:160]
        if not times:
            raise refused(self._path.name, "holds no frame")
        return (width, height), times, declared


def _camera(lens: Path | None, width: int, height: int) -> tuple[Camera, tuple[float, ...]]:
    """The camera at the origin, and its distortion."""
    if lens is None:
        focal = USUAL_FOCAL * max(width, height)
        return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, np.eye(4)), ()
    try:
        facts = json.loads(lens.read_text())
        sizes, lengths = [int(facts[name]) for name in LENS[:2]], [float(facts[name]) for name in LENS[2:]]
        camera = Camera(sizes[0], sizes[1], lengths[0], lengths[1], lengths[2], lengths[3], np.eye(4))
        distortion = tuple(float(value) for value in facts.get("distortion", ()))
        if len(distortion) not in (0, 4, 5, 8) or not np.isfinite(distortion).all():
            raise ValueError(f"{len(distortion)} coefficients of distortion; 4, 5 or 8 finite ones are read")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise refused(lens.name, f"is no camera: {reason(error)[:160]}") from error
    if (camera.width, camera.height) != (width, height):
        raise refused(
            lens.name,
            f"is of {camera.width} x {camera.height} pixels, the pictures have {width} x {height}",
        )
    return camera, distortion


IMPORTER = FolderImporter(
    "film",
    "film, or folder of pictures, of a motion in a plane",
    (".mp4", ".mkv", ".avi"),
    "one colour camera; a board or a length in the plane gives the scale, what is in a box is followed: "
    "`physworld import`, `POST /v1/trackings`",
    is_film,
)
