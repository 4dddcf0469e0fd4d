"""Pictures that come as one file: an archive of a folder of pictures, or a film as it is.

An archive is unpacked within ``LIMITS`` and looked into: its top, or its one top folder, holds the recording.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from physworld_scenes.archives import ArchiveLimits, ArchiveRefused, unpack
from physworld_scenes.errors import refused
from physworld_scenes.importers.film import begins_as_film, is_film
from physworld_scenes.importers.pictures import (
    FILMS,
    PICTURES,
    cameras_in,
    colours_of,
    frames_in,
    is_pictures,
)

GIBIBYTE = 1 << 30
LIMITS = ArchiveLimits(total_bytes=4 * GIBIBYTE, members=40_000)
MOST_SHOWN_BYTES = 8 << 20
"""Of a picture that a preview shows."""
HEADS = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}


def unpacked(upload: Path, filename: str, folder: Path) -> Path:
    """The recording in a file: a folder of pictures, or a film.

    Args:
        upload: the file.
        filename: what its sender calls it; the recording is called so.
        folder: empty, for what an archive holds.

    Raises:
        SceneInvalid: it is neither a film nor an archive of pictures, or damaged, hostile or too large.
    """
    name = _plain(filename)
    with upload.open("rb") as stream:
        film = begins_as_film(stream.read(16))
    if film:
        target = folder / f"{name}{_suffix(filename)}"
        upload.rename(target)
        return target
    top = folder / name
    top.mkdir()
    try:
        unpack(upload, top, LIMITS)
    except ArchiveRefused as error:
        raise refused(filename[:200] or "file", str(error)) from error
    inside = recording_in(top)
    if inside is None:
        held = sorted(path.name for path in top.iterdir())[:8]
        raise refused(
            filename[:200] or "file",
            f"holds {', '.join(held) or 'nothing'}: neither color beside depth, nor a film, nor pictures of one camera",
        )
    return inside


def recording_in(top: Path) -> Path | None:
    """The folder of pictures at the top or in the one top folder; None: there is none."""
    inner = [path for path in top.iterdir() if path.is_dir() and path.name != "__MACOSX"]
    places = [top, *(inner if len(inner) == 1 else [])]
    return next((place for place in places if is_pictures(place) or is_film(place)), None)


def file_in(top: Path, name: str) -> Path:
    """A file that options name, by its path in the archive.

    Args:
        top: of the recording.
        name: relative to it.

    Raises:
        SceneInvalid: it is outside, or not there.
    """
    path = (top / name).resolve()
    if not path.is_relative_to(top.resolve()) or not path.is_file():
        raise refused(name[:200], "is no file of the archive")
    return path


def log_in(top: Path, name: str) -> Path:
    """A robot's log, likewise; it may be the folder of a data set. Raises SceneInvalid."""
    path = (top / name).resolve()
    if path.is_relative_to(top.resolve()) and (path / "meta/info.json").is_file():
        return path
    return file_in(top, name)


def first_pictures(recording: Path) -> tuple[str, list[tuple[str, int, bytes]]]:
    """Which form a recording has, and of each camera name, number of frames (0: not known), and its first picture.

    The picture is PNG or JPEG as it lies there, or made of a film's first frame where this installation decodes films;
    else, and where it is too large to be shown, it is empty.

    Args:
        recording: of ``unpacked``.

    Raises:
        SceneInvalid: there is no picture.
    """
    if is_pictures(recording):
        cameras = cameras_in(colours_of(recording))
        return "rgbd", [(name, *_first(files)) for name, files in cameras.items()]
    if recording.is_file():
        return "film", [(recording.stem, *_first([recording]))]
    films = [path for path in sorted(recording.iterdir()) if path.suffix.lower() in FILMS]
    return "film", [(recording.name, *_first(films or frames_in(recording)))]


def media_type_of(picture: bytes) -> str | None:
    """Of a picture, by its beginning; None: it is none that is shown."""
    return next((kind for head, kind in HEADS.items() if picture.startswith(head)), None)


def _first(files: list[Path]) -> tuple[int, bytes]:
    if files[0].suffix.lower() in PICTURES:
        content = files[0].read_bytes() if files[0].stat().st_size <= MOST_SHOWN_BYTES else b""
        return len(files), content if media_type_of(content) else b""
    return 0, _first_frame(files[0])


def _first_frame(film: Path) -> bytes:
    """As JPEG; empty where films or pictures are not decoded here."""
    try:
        import av
        from PIL import Image  # noqa: F401  (what av makes a picture of)
    except ImportError:
        return b""
    import io

    made = io.BytesIO()
    try:
        with av.open(str(film)) as container:
            frame: Any = next(container.decode(video=0))
            frame.to_image().rotate(frame.rotation, expand=True).save(made, "JPEG", quality=85)
    except (av.FFmpegError, OSError, IndexError, ValueError, StopIteration) as error:
        raise refused(film.name, f"is no film: {str(error)[:160]}") from error
    return made.getvalue()


def _plain(filename: str) -> str:
    """A name for the recording, made of the file's: letters, digits, ``._- `` and no ending of an archive."""
    base = filename.replace("\\", "/").rpartition("/")[2]
    for ending in (".gz", ".zip", ".tar", ".tgz", *FILMS):
        base = base.removesuffix(ending)
    kept = "".join(letter if letter.isalnum() or letter in "._- " else "_" for letter in base)
    return kept.strip(". ")[:60] or "recording"


def _suffix(filename: str) -> str:
    return next((one for one in FILMS if filename.lower().endswith(one)), FILMS[0])
