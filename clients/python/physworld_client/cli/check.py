"""``physworld check SCENE``: what a recording can show before anything is fitted, without the service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli.fit import become

MODULE = "physworld_workers.commands.check"


def check(
    scene: Annotated[Path, typer.Argument(help="Folder, archive, final_data.pkl or C3D file.")],
    json: Annotated[Path | None, typer.Option(help="Write all figures to this file.")] = None,
    noise: Annotated[
        float | None,
        typer.Option(metavar="METRES", help="Deviation per axis to take for the noise."),
    ] = None,
    discrepancy: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="How far a calibrated twin is assumed to be off, over the motion's extent (0.03).",
        ),
    ] = None,
    value: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="A calibrated number that is known better than its prior, in SI units; may be repeated.",
        ),
    ] = None,
    particles: Annotated[int | None, typer.Option(min=50, help="Particles of the twin, about.")] = None,
    motions: Annotated[int | None, typer.Option(min=0, help="Motions that are tried; 0: none.")] = None,
    processes: Annotated[int | None, typer.Option(min=1, help="Processes that simulate.")] = None,
) -> None:
    """Say which parameters and effects this motion can show, at which size, and which motion would show more."""
    given = {
        "--json": json,
        "--noise": noise,
        "--discrepancy": discrepancy,
        "--particles": particles,
        "--motions": motions,
        "--processes": processes,
    }
    options = [text for name, own in given.items() if own is not None for text in (name, str(own))]
    for text in value or []:
        options += ["--value", text]
    become(MODULE, [*options, "--", str(scene)])
