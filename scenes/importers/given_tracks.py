"""Tracks of another tracker as files beside the pictures: ``tracks/CAMERA.npz``, as CoTracker and TAPIR make them.

``tracks`` (T, N, 2): column and row [px] of N points in all T frames of the recording, in its pictures' size.
``visible`` (T, N): whether each is seen, bool, or a share from 0 to 1, of which a half and more is seen.
``centre`` (a number, may be absent): where in these coordinates the middle of the first pixel lies: 0 (CoTracker,
OpenCV) or 0.5 (TAPIR). Points that are not on the object in the first frame are left out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.tracking.given import GivenTracks
from physworld_scenes.archives import ArchiveRefused, read_arrays
from physworld_scenes.errors import refused
from physworld_scenes.importers.pictures import Pictures

FOLDER = "tracks"
MOST_BYTES = 512 << 20
MOST_TRACKS = 100_000
LEAST_TRACKS = 4
MOST_OUTSIDE = 0.02
"""Of the sightings; more of them are those of pictures of another size."""
CENTRES = (0.0, 0.5)


def read_tracks(
    folder: Path, named: dict[int, Path], recording: Pictures, warnings: list[str]
) -> dict[int, GivenTracks]:
    """The tracks of the cameras that have some, of the frames that are read.

    Args:
        folder: of the recording.
        named: files, by camera number; of the others ``tracks/CAMERA.npz`` is read if it is there.
        recording: the pictures.
        warnings: sightings outside of the picture, which do not count, are added.

    Raises:
        SceneInvalid: a file is missing, damaged, or does not fit the pictures; with the numbers.
    """
    beside = {
        number: folder / FOLDER / f"{name}.npz"
        for number, name in enumerate(recording.names)
        if (folder / FOLDER / f"{name}.npz").is_file()
    }
    if (folder / FOLDER).is_dir() and not beside and not named:
        held = sorted(path.name for path in (folder / FOLDER).iterdir())[:8]
        raise refused(
            FOLDER,
            f"holds {', '.join(held) or 'nothing'}, not {', '.join(f'{name}.npz' for name in recording.names)}",
        )
    return {
        number: _read(path, number, recording, warnings) for number, path in sorted((beside | named).items())
    }


def _read(path: Path, number: int, recording: Pictures, warnings: list[str]) -> GivenTracks:
    where = f"tracks of camera {number}"
    if not path.is_file():
        raise refused(where, f"{path.name} is not there")
    if path.stat().st_size > MOST_BYTES:
        raise refused(where, f"{path.name} has {path.stat().st_size} bytes, at most {MOST_BYTES} are read")
    try:
        arrays = read_arrays(path.read_bytes())
    except ArchiveRefused as error:
        raise refused(where, f"{path.name}: {error}") from error
    missing = [name for name in ("tracks", "visible") if name not in arrays]
    if missing:
        raise refused(
            where,
            f"{path.name} has no {' and no '.join(missing)}; it has {', '.join(sorted(arrays))[:160] or 'nothing'}",
        )
    tracks, visible = arrays["tracks"], arrays["visible"]
    if tracks.ndim != 3 or tracks.shape[2] != 2 or visible.shape != tracks.shape[:2]:
        raise refused(
            where, f"tracks {tracks.shape} and visible {visible.shape} are not (T, N, 2) and (T, N)"
        )
    frames, count = visible.shape
    if frames != recording.recorded:
        raise refused(where, f"{frames} frames of tracks, {recording.recorded} of pictures")
    if not LEAST_TRACKS <= count <= MOST_TRACKS:
        raise refused(where, f"{count} points; {LEAST_TRACKS} to {MOST_TRACKS} are read")
    seen = _seen(visible[recording.kept], where)
    pixels = tracks[recording.kept].astype(np.float64) + (0.5 - _centre(arrays, where))
    return _within(pixels, seen, recording.views[number].camera, where, warnings)


def _seen(visible: Array, where: str) -> Array:
    if visible.dtype.kind == "b":
        return visible
    shares = visible.astype(np.float64)
    wrong = ~((shares >= 0.0) & (shares <= 1.0))
    if wrong.any():
        raise refused(
            where,
            f"visible holds {int(wrong.sum())} numbers outside of 0 to 1, such as {shares[wrong][0]:.4g}",
        )
    seen: Array = shares >= 0.5
    return seen


def _centre(arrays: dict[str, Array], where: str) -> float:
    if "centre" not in arrays:
        return 0.0
    centre = arrays["centre"]
    if centre.size != 1 or float(centre.reshape(-1)[0]) not in CENTRES:
        raise refused(where, f"centre is {np.array2string(centre.reshape(-1)[:4])}; it is 0 or 0.5")
    return float(centre.reshape(-1)[0])


def _within(pixels: Array, seen: Array, camera: Camera, where: str, warnings: list[str]) -> GivenTracks:
    """The tracks, not seen where they are outside of the picture; refused where they are too often."""
    unknown = seen & ~np.isfinite(pixels).all(axis=2)
    if unknown.any():
        frame, point = np.argwhere(unknown)[0]
        raise refused(
            where,
            f"{int(unknown.sum())} visible places are no numbers, the first in frame {frame}, point {point}",
        )
    at = np.where(seen[..., None], pixels, 0.5)
    inside = ((at >= 0.0) & (at < [camera.width, camera.height])).all(axis=2)
    outside = int((seen & ~inside).sum())
    if outside > MOST_OUTSIDE * max(int(seen.sum()), 1):
        low, high = at[seen].min(axis=0), at[seen].max(axis=0)
        raise refused(
            where,
            f"{outside} of {int(seen.sum())} visible places are outside of the picture of {camera.width} x "
            f"{camera.height} px; they run from {low[0]:.4g},{low[1]:.4g} to {high[0]:.4g},{high[1]:.4g}",
        )
    if outside:
        warnings.append(f"{where}: {outside} visible places outside of the picture do not count")
    return GivenTracks(pixels, seen & inside)
