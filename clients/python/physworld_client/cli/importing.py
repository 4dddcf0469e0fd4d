"""``physworld import SOURCE --out SCENE``: a recording of any form to a scene, in this process as ``physworld
fit`` does; with ``--service`` a running service makes and keeps it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli import service as services
from physworld_client.cli.fit import become
from physworld_client.cli.importing_there import import_there
from physworld_client.cli.options import PNG_FILE, Data, Token, Url

MODULE = "physworld_workers.commands.importing"


def import_recording(
    source: Annotated[
        Path, typer.Argument(help="File of tracks or markers, archive, film, or folder of pictures.")
    ],
    out: Annotated[Path | None, typer.Option(help="Folder for the scene.")] = None,
    look: Annotated[bool, typer.Option("--look", help="Say what would be guessed, write nothing.")] = False,
    importer: Annotated[str | None, typer.Option(help="Form of the file, instead of by its content.")] = None,
    name: Annotated[str | None, typer.Option(help="Of the scene.")] = None,
    kind: Annotated[str | None, typer.Option(help="Of the object: beam, rope, sheet, toy ...")] = None,
    fps: Annotated[float | None, typer.Option("--fps", "--rate", help="Frames per second.")] = None,
    noise: Annotated[float | None, typer.Option(help="Tracking noise per axis [m].")] = None,
    body: Annotated[
        list[str] | None, typer.Option(help="Markers on the body, by commas; or what is known of it, JSON.")
    ] = None,
    mass: Annotated[float | None, typer.Option(help="Of the body [kg].")] = None,
    density: Annotated[float | None, typer.Option(help="Of the body [kg/m³].")] = None,
    radius: Annotated[float | None, typer.Option(help="Of a rope or rod [m].")] = None,
    thickness: Annotated[float | None, typer.Option(help="Of a sheet [m].")] = None,
    length: Annotated[float | None, typer.Option(help="Of a rope, rod or arm [m].")] = None,
    side: Annotated[float | None, typer.Option(help="Of a square sheet [m].")] = None,
    box_m: Annotated[str | None, typer.Option(help="Box of the body, in the world [m]: X,Y,Z,X,Y,Z.")] = None,
    assume: Annotated[
        bool, typer.Option("--assume", help="Leave open what is not said of the body.")
    ] = False,
    unit: Annotated[str | None, typer.Option(help="Of a table of markers: m, cm, mm, in, ft.")] = None,
    up: Annotated[str | None, typer.Option(help="Axis that points up: x, y, z, -x, -y, -z.")] = None,
    gripper: Annotated[
        str | None,
        typer.Option("--gripper", "--controllers", help="Markers or groups that hold the object, by commas."),
    ] = None,
    box: Annotated[
        list[str] | None, typer.Option(help="Around the object: [CAMERA:]LEFT,TOP,RIGHT,BOTTOM.")
    ] = None,
    mask: Annotated[list[str] | None, typer.Option(help="Instead: PNG, white on it: [CAMERA:]FILE.")] = None,
    tracks: Annotated[
        list[str] | None, typer.Option(help="Of another tracker, npz of tracks and visible: [CAMERA:]FILE.")
    ] = None,
    marker: Annotated[str | None, typer.Option(help="On the gripper: NUMBER[:DICTIONARY], or any.")] = None,
    patch: Annotated[str | None, typer.Option(help="Of the gripper: LEFT,TOP,RIGHT,BOTTOM.")] = None,
    colour: Annotated[str | None, typer.Option(help="A pixel of the gripper's colour: COLUMN,ROW.")] = None,
    log: Annotated[
        Path | None,
        typer.Option(
            help="The robot's log: CSV t,x,y,z[,qw,qx,qy,qz], MCAP, or LeRobot's parquet or folder."
        ),
    ] = None,
    log_pose: Annotated[
        str | None, typer.Option(help="Of it: TOPIC, TOPIC:FRAME of tf, or a prefix of LeRobot's names.")
    ] = None,
    log_episode: Annotated[int | None, typer.Option(min=0, help="Of a log of LeRobot.")] = None,
    log_delay: Annotated[float | None, typer.Option(help="Pictures' clock behind the log's [s].")] = None,
    log_base: Annotated[
        str | None, typer.Option(help="The robot's base in the cameras' world: X,Y,Z,QW,QX,QY,QZ.")
    ] = None,
    held: Annotated[str | None, typer.Option(help="Box around what is held: LEFT,TOP,RIGHT,BOTTOM.")] = None,
    held_m: Annotated[str | None, typer.Option(help="Instead, in the world [m]: X,Y,Z,X,Y,Z.")] = None,
    board: Annotated[
        str | None,
        typer.Option(help="In the plane of a film: charuco:COLUMNSxROWS:SQUARE:MARKER, aruco:… or marker:…"),
    ] = None,
    scale: Annotated[
        str | None, typer.Option(help="Instead, two of its pixels and metres: COLUMN,ROW,COLUMN,ROW,METRES.")
    ] = None,
    camera: Annotated[Path | None, typer.Option(help="JSON of a film's camera.")] = None,
    plumb: Annotated[
        str | None, typer.Option(help="Line along which gravity pulls: COLUMN,ROW,COLUMN,ROW.")
    ] = None,
    before: Annotated[float | None, typer.Option(help="How far the object is before the plane [m].")] = None,
    depth_scale: Annotated[float | None, typer.Option(help="Depth values a metre.")] = None,
    frames: Annotated[str | None, typer.Option(help="FIRST:LAST of the pictures.")] = None,
    points: Annotated[int | None, typer.Option(min=8, help="To follow in each camera.")] = None,
    undeformed: Annotated[
        bool, typer.Option("--undeformed", help="The first frame is undeformed and at rest.")
    ] = False,
    picture: Annotated[Path | None, typer.Option(callback=PNG_FILE, help="PNG of what was followed.")] = None,
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for what films need: a fitted splat, camera, frames.")
    ] = None,
    service: Annotated[
        bool, typer.Option("--service", help="A running service makes the scene and keeps it.")
    ] = False,
    keep_pictures: Annotated[
        bool, typer.Option("--keep-pictures", help="There, keep the first camera's pictures beside it.")
    ] = False,
    fit_splat: Annotated[
        bool, typer.Option("--fit-splat", help="There, fit a splat to the first pictures, for films.")
    ] = False,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Make a scene of a recording; needs no service."""
    given = {
        "--out": out,
        "--name": name,
        "--kind": kind,
        "--fps": fps,
        "--noise": noise,
        "--importer": importer,
        "--mass": mass,
        "--density": density,
        "--radius": radius,
        "--thickness": thickness,
        "--length": length,
        "--side": side,
        "--box-m": box_m,
        "--unit": unit,
        "--up": up,
        "--gripper": gripper,
        "--marker": marker,
        "--patch": patch,
        "--colour": colour,
        "--log": log,
        "--log-pose": log_pose,
        "--log-episode": log_episode,
        "--log-delay": log_delay,
        "--log-base": log_base,
        "--held": held,
        "--held-m": held_m,
        "--board": board,
        "--scale": scale,
        "--camera": camera,
        "--plumb": plumb,
        "--before": before,
        "--depth-scale": depth_scale,
        "--frames": frames,
        "--points": points,
        "--picture": picture,
        "--pictures": pictures,
    }
    several = {"--box": box or [], "--mask": mask or [], "--tracks": tracks or [], "--body": body or []}
    flags = {"--undeformed": undeformed, "--look": look, "--assume": assume}
    if service:
        with services.connect(url, token, data) as client:
            there = {"--keep-pictures": keep_pictures, "--fit-splat": fit_splat}
            import_there(client, source, {**given, **flags, **there}, several)
        return
    if keep_pictures or fit_splat or any(one is not None for one in (url, token, data)):
        raise typer.BadParameter("--keep-pictures, --fit-splat, --url, --token and --data need --service")
    options = [f"{option}={value}" for option, value in given.items() if value is not None]
    options += [f"{option}={value}" for option, values in several.items() for value in values]
    become(MODULE, [*options, *(flag for flag, given in flags.items() if given), "--", str(source)])
