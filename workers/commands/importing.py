"""``python -m physworld_workers.commands.importing SOURCE --out SCENE``: a recording of any form to a scene.

SOURCE is a file of motion capture or tracks, an archive, or a folder of pictures with depth, in which the object is
followed (``--box``). What was found and guessed is printed; what a person knows better is an option. ``--picture``
draws the first frame with the object's pixels and points, and the last one, for a look before anything is fitted.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from physworld.scene import Scene
    from physworld.tracking.recording import Followed
    from physworld_scenes.importers import ImportOptions
    from physworld_scenes.importers.rgbd import PictureOptions


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, import, write."""
    given = _parser().parse_args(arguments)
    from physworld_workers.commands.terminal import guarded

    return guarded(lambda: _import(given))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="physworld import", description="A recording to a scene.")
    parser.add_argument("source", type=Path, help="file, or folder of pictures")
    parser.add_argument("--out", type=Path, required=True, help="folder for the scene")
    parser.add_argument("--name", default=None, help="of the scene")
    parser.add_argument("--kind", default=None, help="of the object: beam, block, rope, sheet, toy ...")
    parser.add_argument(
        "--fps", type=float, default=None, help="frames per second, where the source has none"
    )
    parser.add_argument("--noise", type=float, default=None, help="tracking noise per axis [m]")
    parser.add_argument("--body", default=None, help="what is known of the body: keys of scene.json, as JSON")
    parser.add_argument(
        "--up", default=None, help="axis of the recording that points up: x, y, z, -x, -y, -z"
    )
    parser.add_argument("--controllers", default=None, help="labels of driven or clamped markers, by commas")
    parser.add_argument(
        "--box", action="append", default=[], help="around the object: [CAMERA:]LEFT,TOP,RIGHT,BOTTOM"
    )
    parser.add_argument(
        "--mask", action="append", default=[], help="instead: PNG, white on it: [CAMERA:]FILE"
    )
    parser.add_argument("--marker", default=None, help="on the gripper: NUMBER[:DICTIONARY], or any")
    parser.add_argument("--patch", default=None, help="instead, of the gripper: LEFT,TOP,RIGHT,BOTTOM")
    parser.add_argument("--colour", default=None, help="instead, a pixel of its colour: COLUMN,ROW")
    parser.add_argument(
        "--log", type=Path, default=None, help="instead, the robot's log, CSV: t,x,y,z[,qw,qx,qy,qz]"
    )
    parser.add_argument("--log-delay", type=float, default=0.0, help="pictures' clock behind the log's [s]")
    parser.add_argument("--held", default=None, help="box around what it holds: LEFT,TOP,RIGHT,BOTTOM")
    parser.add_argument("--held-m", default=None, help="instead, in the world [m]: X,Y,Z,X,Y,Z")
    parser.add_argument("--depth-scale", type=float, default=None, help="depth values a metre")
    parser.add_argument("--frames", default=None, help="FIRST:LAST of the pictures")
    parser.add_argument("--points", type=int, default=None, help="to follow in each camera")
    parser.add_argument("--undeformed", action="store_true", help="the first frame is undeformed and at rest")
    parser.add_argument("--picture", type=Path, default=None, help="PNG of what was followed")
    return parser


def _import(given: argparse.Namespace) -> None:
    from physworld_scenes.bundle import read_bundle, write_bundle
    from physworld_scenes.importers import FOLDERS, import_any

    options = _options(given)
    followed = None
    if given.source.is_dir() and any(form.recognises(given.source) for form in FOLDERS):
        scene, warnings, followed = _pictures(given, options)
    elif given.source.is_dir():
        scene, warnings = read_bundle(given.source), []
    else:
        scene, warnings = import_any(given.source.read_bytes(), given.source.name, options)
    write_bundle(scene, given.out)
    _say(scene, warnings, given.out)
    if given.picture is not None and followed is not None:
        _draw(given, followed)


def _options(given: argparse.Namespace) -> ImportOptions:
    from physworld_scenes.importers import ImportOptions

    known: dict[str, Any] = {
        "name": given.name,
        "kind": given.kind,
        "fps": given.fps,
        "noise_sigma_m": given.noise,
        "up": given.up,
        "controllers": tuple(given.controllers.split(",")) if given.controllers else None,
    }
    if given.body is not None:
        try:
            known["body"] = json.loads(given.body)
        except json.JSONDecodeError as error:
            raise ValueError(f"--body is no JSON: {error}") from error
        if not isinstance(known["body"], dict):
            raise ValueError(f"--body must be an object, got {given.body[:80]}")
    return ImportOptions(**{name: value for name, value in known.items() if value is not None})


def _pictures(given: argparse.Namespace, options: ImportOptions) -> tuple[Scene, list[str], Followed]:
    from physworld_scenes.importers.rgbd import read_folder
    from physworld_workers.commands.terminal import progress_bar

    with progress_bar(f"import {given.source.name}") as shown:
        return read_folder(given.source, options, _picture_options(given), shown)


def _picture_options(given: argparse.Namespace) -> PictureOptions:
    from physworld.tracking.points import TrackConfig
    from physworld_scenes.importers.rgbd import GripFrom, PictureOptions

    told = [given.marker, given.patch, given.colour, given.log]
    if sum(each is not None for each in told) > 1:
        raise ValueError("--marker, --patch, --colour and --log exclude each other")
    grip = None
    if any(each is not None for each in told):
        number, _, dictionary = (given.marker or "").partition(":")
        metres = None if given.held_m is None else _numbers("--held-m", given.held_m, 6)
        colour = None if given.colour is None else _numbers("--colour", given.colour, 2)
        grip = GripFrom(
            marker=None if given.marker is None else -1 if number == "any" else _whole("--marker", number),
            dictionary=dictionary or "4X4_50",
            patch=_box("--patch", given.patch),
            colour=None if colour is None else (int(colour[0]), int(colour[1])),
            log=given.log,
            log_delay_s=given.log_delay,
            held_px=_box("--held", given.held),
            held_m=None if metres is None else ((metres[0], metres[1], metres[2]), (metres[3], metres[4], metres[5])),
        )  # fmt: skip
    first, _, last = (given.frames or "").partition(":")
    return PictureOptions(
        boxes={camera: _box("--box", text) for camera, text in map(_of_camera, given.box)},
        masks={camera: Path(text) for camera, text in map(_of_camera, given.mask)},
        grip=grip,
        up=given.up,
        depth_scale=given.depth_scale,
        first=_whole("--frames", first) if first else 0,
        last=_whole("--frames", last) if last else None,
        points=given.points or TrackConfig.points,
        undeformed=given.undeformed,
    )


def _of_camera(text: str) -> tuple[int, str]:
    camera, colon, rest = text.partition(":")
    return (int(camera), rest) if colon and camera.isdecimal() else (0, text)


def _box(option: str, text: str | None) -> Any:
    from physworld.tracking.mask import Box

    return None if text is None else Box(*(int(value) for value in _numbers(option, text, 4)))


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{option} takes {count} numbers with commas between, got {text!r}")
    return values


def _whole(option: str, text: str) -> int:
    if not text.isdecimal():
        raise ValueError(f"{option} takes a whole number, got {text!r}")
    return int(text)


def _say(scene: Scene, warnings: list[str], out: Path) -> None:
    """What was found, for a person to confirm."""
    frames, points = scene.visible.shape
    noise = "unknown" if scene.noise_sigma_m is None else f"{1e3 * scene.noise_sigma_m:.2g} mm"
    print(
        f"{out}: {scene.kind}, {frames} frames at {scene.fps:g} Hz, {points} points seen {scene.visible.mean():.0%} "
        f"of the time, {scene.controllers.shape[1]} controllers, noise {noise}"
    )
    for name, value in scene.declared.get("notes", {}).items():
        print(f"  {name}: {json.dumps(value)}")
    for warning in warnings:
        print(f"  warning: {warning}")


def _draw(given: argparse.Namespace, followed: Followed) -> None:
    """First and last picture of the first camera with mask and points: green seen, red not."""
    from PIL import Image, ImageDraw

    from physworld_scenes.importers.pictures import read_pictures

    options = _picture_options(given)
    view = read_pictures(given.source, given.depth_scale, slice(options.first, options.last)).views[0]
    pictures = []
    for frame in (0, view.frames - 1):
        colour = view.colour(frame).copy()
        if frame == 0 and followed.masks[0].size:
            colour[followed.masks[0]] = colour[followed.masks[0]] // 2 + np.array(
                [0, 60, 110], dtype=np.uint8
            )
        picture = Image.fromarray(colour)
        pen = ImageDraw.Draw(picture)
        for point in np.flatnonzero(followed.cameras == 0):
            x, y = followed.pixels[frame, point]
            if np.isfinite([x, y]).all():
                pen.ellipse(
                    (x - 2, y - 2, x + 2, y + 2), fill="lime" if followed.visible[frame, point] else "red"
                )
        pictures.append(np.asarray(picture))
    given.picture.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack(pictures)).save(given.picture)
    print(f"{given.picture}: the first frame with the object's pixels, and the last")


if __name__ == "__main__":
    sys.exit(main())
