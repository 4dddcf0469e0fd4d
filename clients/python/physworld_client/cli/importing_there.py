"""``physworld import SOURCE --service``: the same options, and a running service makes the scene and keeps it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from physworld_client.bundle import FILMS
from physworld_client.cli.output import progress_text, stdout
from physworld_client.client import Client
from physworld_client.types import Job, Scene
from physworld_schemas.scene import SceneImport
from physworld_schemas.tracking import TrackingOptions

FACTS = {
    "--mass": "mass_kg",
    "--density": "density_kg_m3",
    "--radius": "radius_m",
    "--thickness": "thickness_m",
    "--length": "length_m",
    "--side": "side_m",
}
NOT_THERE = {
    "--out": "the service keeps the scene",
    "--look": "`physworld scenes add --preview` looks",
    "--pictures": "--keep-pictures keeps them, --fit-splat fits a splat",
}
BESIDE = "given/{}"
"""Where files that options name lie in the archive."""


def import_there(
    client: Client, source: Path, given: Mapping[str, Any], several: Mapping[str, Sequence[str]]
) -> None:
    """Upload a recording, wait for its scene, say what was made.

    Args:
        client: of the service.
        source: folder or file.
        given: options by their names; None: not given.
        several: options that are given more than once.
    """
    for option, instead in NOT_THERE.items():
        if given.get(option) not in (None, False):
            raise typer.BadParameter(f"{option} is for an import without --service: {instead}")
    pictures = [name for name in ("--box", "--mask", "--tracks") if several[name]]
    folder = source.is_dir() and not (source / "scene.json").is_file()
    if not (pictures or folder or source.suffix.lower() in FILMS):
        scene = client.scenes.create(source, SceneImport.model_validate(_table(given, several)))
        _say(scene)
        return
    options, files = _tracking(given, several)
    job = client.trackings.create(source, TrackingOptions.model_validate(options), files)
    job = client.jobs.wait(job, on_progress=_tell)
    scene = client.scenes.get(job.outputs[0].id)
    _say(scene)
    if given["--picture"] is not None:
        look = next(item for item in scene.artifacts if item.name == "followed.png")
        stdout.print(str(client.artifacts.download(look, given["--picture"])), markup=False, soft_wrap=True)


def _facts(
    given: Mapping[str, Any], several: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Any], list[str]]:
    """What recordings of every form are told, and the names of markers on the body."""
    body: dict[str, Any] = {}
    names: list[str] = []
    for text in several["--body"]:
        if text.lstrip().startswith("{"):
            try:
                body |= json.loads(text)
            except json.JSONDecodeError as error:
                raise typer.BadParameter(f"--body is no JSON: {error}") from error
        else:
            names += _names(text)
    body |= {key: given[option] for option, key in FACTS.items() if given[option] is not None}
    if given["--box-m"] is not None:
        corners = _numbers("--box-m", given["--box-m"], 6)
        body |= {"box_min_m": corners[:3], "box_max_m": corners[3:]}
    told = {
        "name": given["--name"],
        "kind": given["--kind"],
        "fps": given["--fps"],
        "noise_sigma_m": given["--noise"],
        "up": given["--up"],
        "body": body or None,
    }
    return {name: value for name, value in told.items() if value is not None}, names


def _table(given: Mapping[str, Any], several: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    facts, names = _facts(given, several)
    gripper = given["--gripper"]
    told = {
        "unit": given["--unit"],
        "importer": given["--importer"],
        "controllers": None if gripper is None else _names(gripper),
        "markers": names or None,
    }
    return facts | {"assume": given["--assume"]} | {name: v for name, v in told.items() if v is not None}


def _tracking(
    given: Mapping[str, Any], several: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Any], dict[str, Path]]:
    """Options of a tracking, and the files that they name."""
    files: dict[str, Path] = {}

    def beside(path: str | Path) -> str:
        name = BESIDE.format(Path(path).name)
        if files.setdefault(name, Path(path)) != Path(path):
            raise typer.BadParameter(f"{path} and {files[name]} have one name")
        return name

    def with_log(path: Path) -> str:
        """A log of LeRobot comes with what names its components; a data set without its films."""
        if path.is_dir():
            inside = [path / "meta/info.json", *sorted(path.glob("data/**/*.parquet"))]
            name = BESIDE.format(path.resolve().name)
            files.update({f"{name}/{one.relative_to(path).as_posix()}": one for one in inside})
            return name
        if path.suffix.lower() == ".parquet":
            near = [
                path.parent / "info.json",
                *(top / "meta/info.json" for top in list(path.resolve().parents)[:3]),
            ]
            files.update({BESIDE.format("info.json"): one for one in near[::-1] if one.is_file()})
        return beside(path)

    facts, _ = _facts(given, several)
    first, _, last = (given["--frames"] or "").partition(":")
    gripper, plane = _gripper(given, beside, with_log), _plane(given, beside)
    told = {
        "boxes": {camera: _pixels("--box", text, 4) for camera, text in map(_of_camera, several["--box"])},
        "masks": {camera: beside(text) for camera, text in map(_of_camera, several["--mask"])},
        "tracks": {camera: beside(text) for camera, text in map(_of_camera, several["--tracks"])},
        "gripper": gripper or None,
        "plane": plane or None,
        "depth_scale": given["--depth-scale"],
        "first": _pixels("--frames", first, 1)[0] if first else None,
        "last": _pixels("--frames", last, 1)[0] if last else None,
        "points": given["--points"],
        "undeformed": given["--undeformed"],
        "keep_pictures": given["--keep-pictures"],
        "fit_splat": given["--fit-splat"],
    }
    return facts | {name: value for name, value in told.items() if value not in (None, {}, False)}, files


def _gripper(
    given: Mapping[str, Any], beside: Callable[[str | Path], str], with_log: Callable[[Path], str]
) -> dict[str, Any]:
    told: dict[str, Any] = {}
    if given["--marker"] is not None:
        number, _, dictionary = given["--marker"].partition(":")
        told["marker"] = -1 if number == "any" else _pixels("--marker", number, 1)[0]
        told |= {"dictionary": dictionary} if dictionary else {}
    for option, key, count in (("--patch", "patch", 4), ("--colour", "colour", 2), ("--held", "held_px", 4)):
        if given[option] is not None:
            told[key] = _pixels(option, given[option], count)
    if given["--log"] is not None:
        told["log"] = with_log(given["--log"])
    for option, key in (
        ("--log-pose", "log_pose"),
        ("--log-episode", "log_episode"),
        ("--log-delay", "log_delay_s"),
    ):
        if given[option] is not None:
            told[key] = given[option]
    if given["--log-base"] is not None:
        told["log_base"] = _numbers("--log-base", given["--log-base"], 7)
    if given["--held-m"] is not None:
        corners = _numbers("--held-m", given["--held-m"], 6)
        told["held_m"] = [corners[:3], corners[3:]]
    return told


def _plane(given: Mapping[str, Any], beside: Any) -> dict[str, Any]:
    told: dict[str, Any] = {}
    if given["--board"] is not None:
        told["board"] = given["--board"]
    if given["--scale"] is not None:
        numbers = _numbers("--scale", given["--scale"], 5)
        told |= {"pixels": numbers[:4], "length_m": numbers[4]}
    if given["--camera"] is not None:
        told["lens"] = beside(given["--camera"])
    if given["--plumb"] is not None:
        told["plumb"] = _numbers("--plumb", given["--plumb"], 4)
    if given["--before"] is not None:
        told["before_m"] = given["--before"]
    return told


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _of_camera(text: str) -> tuple[str, str]:
    camera, colon, rest = text.partition(":")
    return (camera, rest) if colon and camera.isdecimal() else ("0", text)


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise typer.BadParameter(f"{option} takes {count} numbers with commas between, got {text!r}")
    return values


def _pixels(option: str, text: str, count: int) -> list[int]:
    return [int(value) for value in _numbers(option, text, count)]


def _tell(job: Job) -> None:
    stdout.print(f"{job.state}  {progress_text(job)}", markup=False, soft_wrap=True)


def _say(scene: Scene) -> None:
    noise = "unknown" if scene.noise_sigma_m is None else f"{1e3 * scene.noise_sigma_m:.2g} mm"
    stdout.print(
        f"{scene.id}: {scene.name}, {scene.kind}, {scene.frames} frames at {scene.fps:g} Hz, {scene.points} points, "
        f"{scene.controllers} controllers, noise {noise}",
        markup=False,
        soft_wrap=True,
    )
    for warning in scene.warnings:
        stdout.print(f"  warning: {warning}", markup=False, soft_wrap=True)
