"""``python -m physworld_workers.commands.importing SOURCE --out SCENE``: a recording of any form to a scene.

SOURCE is a file of marker tracks, an archive, or a folder of pictures with depth or a film of a motion in a plane, in
which the object is followed (``--box``). What was found and guessed is printed; what a person knows better is an
option. ``--look`` prints it and writes nothing. ``--picture`` draws the first frame with the object's pixels and
points, and the last one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physworld_workers.commands import importing_planar as planar
from physworld_workers.commands.importing_planar import numbers

if TYPE_CHECKING:
    from physworld.scene import Scene
    from physworld.tracking.recording import Followed
    from physworld_scenes.importers import ImportOptions
    from physworld_scenes.importers.rgbd import PictureOptions


FACTS = (
    ("--mass", "mass_kg", "kg", "mass"),
    ("--density", "density_kg_m3", "kg/m³", "density"),
    ("--radius", "radius_m", "m", "radius"),
    ("--thickness", "thickness_m", "m", "thickness"),
    ("--length", "length_m", "m", "length"),
    ("--side", "side_m", "m", "side"),
)
"""Options that are keys of the body, with unit and words."""
OPTIONS = {
    "up": "--up",
    "unit": "--unit",
    "fps": "--rate",
    "controllers": "--gripper",
    "markers": "--body",
    "noise_sigma_m": "--noise",
}
"""What says otherwise than a guess."""
WIDEST = 70
MOST_FILE_BYTES = 1 << 30


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, import, write."""
    given = _parser().parse_args(arguments)
    from physworld_workers.commands.terminal import guarded

    return guarded(lambda: _import(given))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="physworld import", description="A recording to a scene.")
    parser.add_argument("source", type=Path, help="file, or folder of pictures")
    parser.add_argument("--out", type=Path, default=None, help="folder for the scene")
    parser.add_argument("--look", action="store_true", help="say what would be guessed, write nothing")
    parser.add_argument("--importer", default=None, help="form of the file, instead of by its content")
    parser.add_argument("--name", default=None, help="of the scene")
    parser.add_argument("--kind", default=None, help="of the object: beam, block, rope, sheet, toy ...")
    parser.add_argument("--fps", "--rate", type=float, default=None, help="frames per second")
    parser.add_argument("--noise", type=float, default=None, help="tracking noise per axis [m]")
    parser.add_argument(
        "--body",
        action="append",
        default=[],
        help="markers on the body, by commas; or what is known of it, as JSON: keys of scene.json's body",
    )
    for option, _, unit, what in FACTS:
        parser.add_argument(option, type=float, default=None, help=f"{what} of the body [{unit}]")
    parser.add_argument(
        "--box-m", default=None, help="box of the body at rest, in the scene's world [m]: X,Y,Z,X,Y,Z"
    )
    parser.add_argument(
        "--assume", action="store_true", help="leave facts of the body open that are not said"
    )
    parser.add_argument("--unit", default=None, help="of a table of markers: m, cm, mm, in, ft")
    parser.add_argument(
        "--up", default=None, help="axis of the recording that points up: x, y, z, -x, -y, -z"
    )
    parser.add_argument(
        "--gripper",
        "--controllers",
        dest="controllers",
        default=None,
        help="markers, groups or rigid bodies that hold the object, by commas; none: nothing does",
    )
    parser.add_argument(
        "--box", action="append", default=[], help="around the object: [CAMERA:]LEFT,TOP,RIGHT,BOTTOM"
    )
    parser.add_argument(
        "--mask", action="append", default=[], help="instead: PNG, white on it: [CAMERA:]FILE"
    )
    parser.add_argument(
        "--tracks",
        action="append",
        default=[],
        help="of another tracker, npz of tracks and visible: [CAMERA:]FILE; else tracks/CAMERA.npz",
    )
    parser.add_argument("--marker", default=None, help="on the gripper: NUMBER[:DICTIONARY], or any")
    parser.add_argument("--patch", default=None, help="instead, of the gripper: LEFT,TOP,RIGHT,BOTTOM")
    parser.add_argument("--colour", default=None, help="instead, a pixel of its colour: COLUMN,ROW")
    parser.add_argument(
        "--log",
        type=Path,
        default=None,
        help="instead, the robot's log: CSV of t,x,y,z[,qw,qx,qy,qz], MCAP, or LeRobot's parquet or folder",
    )
    parser.add_argument(
        "--log-pose",
        default=None,
        help="which pose of it: TOPIC, TOPIC:FRAME of tf, or a prefix of LeRobot's names",
    )
    parser.add_argument("--log-episode", type=int, default=None, help="which episode of LeRobot")
    parser.add_argument("--log-delay", type=float, default=0.0, help="pictures' clock behind the log's [s]")
    parser.add_argument(
        "--log-base", default=None, help="robot's base in the cameras' world: X,Y,Z,QW,QX,QY,QZ"
    )
    parser.add_argument("--held", default=None, help="box around what it holds: LEFT,TOP,RIGHT,BOTTOM")
    parser.add_argument("--held-m", default=None, help="instead, in the world [m]: X,Y,Z,X,Y,Z")
    parser.add_argument("--depth-scale", type=float, default=None, help="depth values a metre")
    parser.add_argument("--frames", default=None, help="FIRST:LAST of the pictures")
    parser.add_argument("--points", type=int, default=None, help="to follow in each camera")
    parser.add_argument("--undeformed", action="store_true", help="the first frame is undeformed and at rest")
    parser.add_argument("--picture", type=Path, default=None, help="PNG of what was followed")
    parser.add_argument(
        "--pictures",
        type=Path,
        default=None,
        help="folder for what films need: a fitted splat, camera, frames",
    )
    planar.add_options(parser)
    return parser


def _import(given: argparse.Namespace) -> None:
    from physworld_scenes.bundle import read_bundle
    from physworld_scenes.importers import import_any
    from physworld_scenes.importers.film import is_film
    from physworld_scenes.importers.pictures import is_pictures

    if given.out is None and not given.look:
        raise ValueError("--out is missing: the folder for the scene; or --look")
    options = _options(given)
    if given.look:
        _look(given, options)
        return
    with_depth, filmed = is_pictures(given.source), is_film(given.source)
    if given.pictures is not None and not with_depth:
        raise ValueError(
            f"--pictures {given.pictures} needs pictures with depth, which {given.source} does not hold"
        )
    if given.picture is not None and not (with_depth or filmed):
        raise ValueError(f"--picture {given.picture} needs pictures, which {given.source} does not hold")
    planar.require_film(given, filmed)
    followed = None
    if with_depth:
        scene, warnings, followed = _pictures(given, options)
    elif filmed:
        scene, warnings, followed = planar.read(given, options, _picture_options(given))
    elif given.source.is_dir():
        scene, warnings = read_bundle(given.source), []
    else:
        scene, warnings = import_any(_content(given.source), given.source.name, options)
    _write(scene, given.out)
    _say(scene, warnings, given.out)
    if given.picture is not None and followed is not None:
        _draw(given, followed)
    if given.pictures is not None and followed is not None:
        _keep_pictures(given.pictures, followed)


def _options(given: argparse.Namespace) -> ImportOptions:
    from physworld_scenes.importers import ImportOptions

    known: dict[str, Any] = {
        "name": given.name,
        "kind": given.kind,
        "fps": given.fps,
        "noise_sigma_m": given.noise,
        "up": given.up,
        "controllers": _names(given.controllers),
        "unit": given.unit,
        "importer": given.importer,
        "assume": given.assume,
    }
    facts: dict[str, Any] = {}
    names: list[str] = []
    for text in given.body:
        if text.lstrip().startswith("{"):
            try:
                facts |= json.loads(text)
            except json.JSONDecodeError as error:
                raise ValueError(f"--body is no JSON: {error}") from error
        else:
            names += _names(text) or ()
    for _, key, _, _ in FACTS:
        if getattr(given, key.partition("_")[0]) is not None:
            facts[key] = getattr(given, key.partition("_")[0])
    if given.box_m is not None:
        corners = numbers("--box-m", given.box_m, 6)
        facts |= {"box_min_m": corners[:3], "box_max_m": corners[3:]}
    known |= {"body": facts or None, "markers": tuple(names) or None}
    return ImportOptions(**{name: value for name, value in known.items() if value is not None})


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(name.strip() for name in text.split(",") if name.strip()) or None


def _look(given: argparse.Namespace, options: ImportOptions) -> None:
    """Print what an import would guess."""
    from physworld_scenes.importers import look_at

    title, found = look_at(_content(given.source), given.source.name, options)
    print(f"{given.source}: {title}; nothing was written")
    _table(found.guesses)
    for line in found.lines:
        print(f"  {line}")


def _content(source: Path) -> bytes:
    size = source.stat().st_size
    if size > MOST_FILE_BYTES:
        raise ValueError(f"{source.name} has {size} bytes, at most {MOST_FILE_BYTES} are read")
    return source.read_bytes()


def _table(rows: Sequence[tuple[str, str, str, str]]) -> None:
    """Guesses as columns: what, value, how, the option that says otherwise."""
    widths = [min(max(len(row[column]) for row in rows), WIDEST) for column in range(3)] if rows else []
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=False)]
        print("  " + "  ".join([*cells, OPTIONS[row[3]]]))


def _write(scene: Scene, out: Path) -> None:
    """Write the bundle; where that fails, nothing of it stays, and what was there before does."""
    from physworld_scenes.bundle import write_bundle

    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    out.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=".import-", dir=out))
    try:
        write_bundle(scene, part)
        for file in sorted(part.rglob("*")):
            if file.is_file():
                target = out / file.relative_to(part)
                target.parent.mkdir(parents=True, exist_ok=True)
                file.replace(target)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise
    shutil.rmtree(part)


def _pictures(given: argparse.Namespace, options: ImportOptions) -> tuple[Scene, list[str], Followed]:
    from physworld_scenes.importers.rgbd import read_folder
    from physworld_workers.commands.terminal import progress_bar

    with progress_bar(f"import {given.source.name}") as shown:
        return read_folder(given.source, options, _picture_options(given), shown)


def _picture_options(given: argparse.Namespace) -> PictureOptions:
    from physworld.tracking.places import TrackConfig
    from physworld_scenes.importers.gripping import GripFrom
    from physworld_scenes.importers.rgbd import PictureOptions

    told = [given.marker, given.patch, given.colour, given.log]
    if sum(each is not None for each in told) > 1:
        raise ValueError("--marker, --patch, --colour and --log exclude each other")
    grip = None
    if any(each is not None for each in told):
        number, _, dictionary = (given.marker or "").partition(":")
        metres = None if given.held_m is None else numbers("--held-m", given.held_m, 6)
        colour = None if given.colour is None else numbers("--colour", given.colour, 2)
        grip = GripFrom(
            marker=None if given.marker is None else -1 if number == "any" else _whole("--marker", number),
            dictionary=dictionary or "4X4_50",
            patch=_box("--patch", given.patch),
            colour=None if colour is None else (int(colour[0]), int(colour[1])),
            log=given.log,
            log_pose=given.log_pose,
            log_episode=given.log_episode,
            log_delay_s=given.log_delay,
            log_base=None if given.log_base is None else tuple(numbers("--log-base", given.log_base, 7)),
            held_px=_box("--held", given.held),
            held_m=None if metres is None else ((metres[0], metres[1], metres[2]), (metres[3], metres[4], metres[5])),
        )  # fmt: skip
    first, _, last = (given.frames or "").partition(":")
    return PictureOptions(
        boxes={camera: _box("--box", text) for camera, text in map(_of_camera, given.box)},
        masks={camera: Path(text) for camera, text in map(_of_camera, given.mask)},
        tracks={camera: Path(text) for camera, text in map(_of_camera, given.tracks)},
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
    from physworld.tracking.view import Box

    return None if text is None else Box(*(int(value) for value in numbers(option, text, 4)))


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
    notes = dict(scene.declared.get("notes") or {})
    guesses = notes.pop("guessed", None)
    if isinstance(guesses, list):
        _table([(g["what"], g["value"], g["how"], g["option"]) for g in guesses])
        for line in notes.pop("left_out", []):
            print(f"  {line}")
        for labels in ("point_labels", "controller_labels", "noise"):
            notes.pop(labels, None)
    for name, value in notes.items():
        print(f"  {name}: {json.dumps(value)}")
    for warning in warnings:
        print(f"  warning: {warning}")


def _draw(given: argparse.Namespace, followed: Followed) -> None:
    from PIL import Image

    from physworld_workers.followed_pictures import first_and_last

    given.picture.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(first_and_last(followed)).save(given.picture)
    print(f"{given.picture}: the first frame of every camera with the object's pixels, and the last")


def _keep_pictures(folder: Path, followed: Followed) -> None:
    """What ``physworld scenes picture`` takes: splat of the first frame, first camera, and its pictures."""
    from physworld.video import SplatConfig
    from physworld_workers.commands.splat import fitted_splat
    from physworld_workers.followed_pictures import splat_views, write_camera, write_frames

    fitted_splat(splat_views(followed), None, SplatConfig(), folder / "splat.ply")
    view = followed.views[0]
    write_camera(view, folder / "camera.json")
    write_frames(view, folder / "frames.npz")
    print(f"{folder}: splat.ply, camera.json, frames.npz of camera 0 ({view.frames} frames)")


if __name__ == "__main__":
    sys.exit(main())
