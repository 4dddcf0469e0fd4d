"""``physworld fit SCENE``: calibrate a twin without the service; ``physworld fit A B``: of several recordings.

This process becomes the command (``python -m physworld_workers.commands.fit``), so that Ctrl-C reaches exactly one
process, its exit code is this one's, and the client imports no engine.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli.options import JSON_FILE
from physworld_client.errors import PhysWorldError

MODULE = "physworld_workers.commands.fit"


def fit(
    scenes: Annotated[
        list[Path],
        typer.Argument(
            metavar="SCENE...",
            help="Folder, archive, final_data.pkl or C3D file; several are recordings of one object.",
        ),
    ],
    json: Annotated[
        Path | None, typer.Option(callback=JSON_FILE, help="Write the figures to this file.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the twin and its prediction.")] = None,
    particles: Annotated[int | None, typer.Option(min=50, help="Particles of the twin, about.")] = None,
    simulations: Annotated[int | None, typer.Option(min=1, help="Most simulations of the search.")] = None,
    law: Annotated[
        str | None, typer.Option(help="Elastic law by name, or auto: choose it by the data.")
    ] = None,
    plasticity: Annotated[
        str | None, typer.Option(help="Flow law by name; its yield is calibrated too.")
    ] = None,
    formulation: Annotated[
        str | None, typer.Option(help="total_lagrangian, updated_lagrangian, discrete_rod or auto.")
    ] = None,
    transfer: Annotated[
        str | None, typer.Option(help="Of the updated Lagrangian form: apic or asflip.")
    ] = None,
    mesh: Annotated[
        str | None,
        typer.Option(help="Of a sheet: the mesh of triangles that recorded it, such as 16x15."),
    ] = None,
    stages: Annotated[
        str | None, typer.Option(help="global, or global+local: a field over the body on top, if it holds.")
    ] = None,
    processes: Annotated[
        int | None, typer.Option(min=1, help="Processes that share the simulations [1].")
    ] = None,
    resume: Annotated[
        Path | None, typer.Option(help="File of finished steps: a fit that was ended goes on from it.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Leave out the runs on finer cells and steps.")
    ] = False,
) -> None:
    """Calibrate a twin in this process and measure it on the held-out frames; needs no service."""
    given = {
        "--json": json,
        "--out": out,
        "--particles": particles,
        "--simulations": simulations,
        "--law": law,
        "--plasticity": plasticity,
        "--formulation": formulation,
        "--transfer": transfer,
        "--mesh": mesh,
        "--stages": stages,
        "--processes": processes,
        "--resume": resume,
    }
    options = [text for name, value in given.items() if value is not None for text in (name, str(value))]
    become(MODULE, [*options, *(["--quick"] if quick else []), "--", *map(str, scenes)])


def become(module: str, arguments: list[str]) -> None:
    """Replace this process by ``python -m module``. Raises PhysWorldError where only the client is installed."""
    if importlib.util.find_spec("physworld_workers") is None or importlib.util.find_spec("warp") is None:
        raise PhysWorldError(
            "the engine is not installed here, only the client: install the distribution physworld with the "
            "extras api and sim"
        )
    sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])
