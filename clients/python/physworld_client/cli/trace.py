"""``physworld trace SCENE``: trace the residual of a calibrated twin to a named effect, without the service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli.fit import become

MODULE = "workers.commands.trace"


def trace(
    scene: Annotated[Path, typer.Argument(help="Folder, archive, final_data.pkl or C3D file.")],
    out: Annotated[Path | None, typer.Option(help="Write the report to this file.")] = None,
    predictions: Annotated[
        Path | None, typer.Option(help="Write the tracks before and after to this npz.")
    ] = None,
    html: Annotated[Path | None, typer.Option(help="Write the report as a page to this file.")] = None,
    particles: Annotated[int | None, typer.Option(min=50, help="Particles of the twin, about.")] = None,
    processes: Annotated[int | None, typer.Option(min=1, help="Processes that simulate.")] = None,
    resume: Annotated[
        Path | None, typer.Option(help="Folder that remembers every simulation, to go on after a cut.")
    ] = None,
) -> None:
    """Name the effect that a twin lacks, add it, and report the held-out error before and after."""
    given = {
        "--out": out,
        "--predictions": predictions,
        "--html": html,
        "--particles": particles,
        "--processes": processes,
        "--resume": resume,
    }
    options = [text for name, value in given.items() if value is not None for text in (name, str(value))]
    become(MODULE, [*options, "--", str(scene)])
