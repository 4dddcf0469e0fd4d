"""``physworld splat SCENE``: fit a splat to pictures of a scene's first frame, in this process as ``physworld fit``
does."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli.fit import become
from physworld_client.cli.options import JSON_FILE, PLY_FILE

MODULE = "physworld_workers.commands.splat"


def splat(
    scene: Annotated[Path, typer.Argument(help="Scene whose first frame the pictures show.")],
    picture: Annotated[list[Path], typer.Option(help="PNG or JPEG; once a camera.")],
    camera: Annotated[list[Path], typer.Option(help="Its camera, JSON; in the same order.")],
    out: Annotated[Path, typer.Option(callback=PLY_FILE, help="The splat, PLY.")],
    mask: Annotated[
        list[Path] | None, typer.Option(help="PNG, white on the object; in the same order.")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Of the fit [200].")] = None,
    most: Annotated[int | None, typer.Option(min=1, help="Gaussians at most [20000].")] = None,
    json: Annotated[
        Path | None, typer.Option(callback=JSON_FILE, help="Write the losses to this file.")
    ] = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda.")] = None,
) -> None:
    """Fit a splat to pictures of a scene's first frame; needs no service."""
    given = {"--out": out, "--steps": steps, "--most": most, "--json": json, "--device": device}
    options = [f"{name}={value}" for name, value in given.items() if value is not None]
    many = {"--picture": picture, "--camera": camera, "--mask": mask or []}
    options += [f"{name}={value}" for name, values in many.items() for value in values]
    become(MODULE, [*options, "--", str(scene)])
