"""``python -m physworld_workers.tracking_child FOLDER``: the process that reads and follows a stranger's pictures.

Started by ``physworld_workers.tasks.tracking``, without keys or addresses, under limits that the kernel keeps: a forged
archive, picture, film or calibration can end this process and nothing else. ``FOLDER`` holds ``upload`` and
``request.json`` (``file``, its name; ``options``, a ``TrackingOptions``). How far it is, is told on standard output, a
line of JSON each: ``[done, total, message]``. Left in ``FOLDER``: ``scene.zip``, ``followed.png``, with
``keep_pictures`` also ``camera.json`` and ``frames.npz``, with ``fit_splat`` ``views.npz``, and ``found.json``, the
scene's facts; or its faults alone.
"""

from __future__ import annotations

import errno
import json
import os
import sys
import tempfile
from pathlib import Path

from physworld.scene import Scene
from physworld.tracking.places import TrackConfig
from physworld.tracking.recording import Followed
from physworld.tracking.view import Box
from physworld_scenes.bundle import write_archive
from physworld_scenes.errors import SceneInvalid, refused
from physworld_scenes.facts import facts_of
from physworld_scenes.importers.gripping import GripFrom
from physworld_scenes.importers.library import limit_here
from physworld_scenes.importers.options import ImportOptions
from physworld_scenes.importers.pictures import is_pictures
from physworld_scenes.importers.planar.place import PlaneFrom
from physworld_scenes.importers.planar.reading import read_planar
from physworld_scenes.importers.rgbd import PictureOptions, read_folder
from physworld_scenes.importers.unpacked import file_in, log_in, unpacked
from physworld_scenes.limited import die_with_parent, told
from physworld_schemas.tracking import FilmPlane, Gripper, PixelBox, TrackingOptions
from physworld_schemas.video import MOST_FRAMES
from physworld_workers.commands.importing_planar import board_of
from physworld_workers.followed_pictures import (
    first_and_last,
    splat_views,
    write_camera,
    write_frames,
    write_views,
)
from physworld_workers.tracking_files import (
    ARCHIVE,
    CAMERA,
    FOUND,
    FRAMES,
    LIMITS,
    LOOK,
    MOST_KEPT_BYTES,
    NO_MEMORY,
    NO_ROOM,
    REFUSED,
    REQUEST,
    UPLOAD,
    VIEWS,
)

DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


def main(folder: Path) -> int:
    """Read, follow, write; the exit status."""
    import cv2

    die_with_parent()
    LIMITS.impose()
    limit_here()
    tempfile.tempdir = str(folder)
    try:
        scene, warnings, followed, options = _tracked(folder)
        with (folder / ARCHIVE).open("w+b") as stream:
            write_archive(scene, stream)
        _draw(folder / LOOK, followed)
        if options.keep_pictures:
            _keep(folder, followed)
        if options.fit_splat:
            write_views(splat_views(followed), folder / VIEWS)
        (folder / FOUND).write_text(json.dumps(facts_of(scene, warnings)))
        return 0
    except SceneInvalid as error:
        (folder / FOUND).write_text(json.dumps({"faults": told(error.faults)}))
        return REFUSED
    except MemoryError:
        return NO_MEMORY
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem or "bad_alloc" in str(error):
            return NO_MEMORY
        raise
    except OSError as error:
        if error.errno in DISK_FULL:
            return NO_ROOM
        raise


def _tracked(folder: Path) -> tuple[Scene, list[str], Followed, TrackingOptions]:
    request = json.loads((folder / REQUEST).read_text())
    options = TrackingOptions.model_validate(request["options"])
    tell(0, 1, "reading, unpacking")
    place = folder / "pictures"
    place.mkdir()
    recording = unpacked(folder / UPLOAD, request["file"], place)
    facts = options.model_dump(include={"name", "kind", "fps", "noise_sigma_m", "gravity_m_s2", "body", "up"})
    known = ImportOptions(**{name: value for name, value in facts.items() if value is not None})
    top = recording if recording.is_dir() else recording.parent
    said = _pictures(options, top)
    if is_pictures(recording):
        if options.plane is not None:
            raise refused("plane", "is of a film or pictures of one camera; these pictures have depth")
        return *read_folder(recording, known, said, tell), options
    if options.plane is None:
        raise refused("plane", "is missing: a film needs a board or a length that tells its plane and scale")
    if options.fit_splat:
        raise refused("fit_splat", "is of pictures with depth; films of a plane have none")
    return *read_planar(recording, known, said, _plane(options.plane, top), tell), options


def _pictures(options: TrackingOptions, top: Path) -> PictureOptions:
    return PictureOptions(
        boxes={camera: Box(*corners) for camera, corners in options.boxes.items()},
        masks={camera: file_in(top, name) for camera, name in options.masks.items()},
        tracks={camera: file_in(top, name) for camera, name in options.tracks.items()},
        grip=None if options.gripper is None else _grip(options.gripper, top),
        up=options.up,
        depth_scale=options.depth_scale,
        first=options.first,
        last=options.last,
        points=options.points or TrackConfig.points,
        undeformed=options.undeformed,
    )


def _grip(gripper: Gripper, top: Path) -> GripFrom:
    def box(corners: PixelBox | None) -> Box | None:
        return None if corners is None else Box(*corners)

    return GripFrom(
        marker=gripper.marker,
        dictionary=gripper.dictionary,
        patch=box(gripper.patch),
        colour=gripper.colour,
        log=None if gripper.log is None else log_in(top, gripper.log),
        log_pose=gripper.log_pose,
        log_episode=gripper.log_episode,
        log_delay_s=gripper.log_delay_s,
        log_base=gripper.log_base,
        held_px=box(gripper.held_px),
        held_m=gripper.held_m,
    )


def _plane(plane: FilmPlane, top: Path) -> PlaneFrom:
    try:
        board = None if plane.board is None else board_of(plane.board)
    except ValueError as error:
        raise refused("board", str(error)) from error
    first, last = (None, None) if plane.pixels is None else (plane.pixels[:2], plane.pixels[2:])
    return PlaneFrom(
        board=board,
        pixels=None if first is None or last is None else (first, last),
        length_m=plane.length_m,
        lens=None if plane.lens is None else file_in(top, plane.lens),
        plumb=None if plane.plumb is None else (plane.plumb[:2], plane.plumb[2:]),
        before_m=plane.before_m,
    )


def _draw(path: Path, followed: Followed) -> None:
    from PIL import Image

    Image.fromarray(first_and_last(followed)).save(path)


def _keep(folder: Path, followed: Followed) -> None:
    view = followed.views[0]
    size = 3 * view.frames * view.camera.width * view.camera.height
    if view.frames > MOST_FRAMES or size > MOST_KEPT_BYTES:
        raise refused(
            "keep_pictures",
            f"{view.frames} pictures of {size} bytes; at most {MOST_FRAMES} of {MOST_KEPT_BYTES} are kept",
        )
    write_camera(view, folder / CAMERA)
    write_frames(view, folder / FRAMES)


def tell(done: int, total: int, message: str) -> None:
    """A line of progress."""
    print(json.dumps([done, total, message]), flush=True)


if __name__ == "__main__":
    os.umask(0o077)
    sys.exit(main(Path(sys.argv[1])))
