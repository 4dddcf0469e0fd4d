"""``physworld trace SCENE``: trace the residual of a calibrated twin to a named effect, without the service.

``physworld trace A B --held-out C D``: several recordings of one object, and some that only the report sees.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from physworld_client.cli.fit import become
from physworld_client.cli.options import HTML_FILE, NPZ_FILE, written_as

MODULE = "physworld_workers.commands.trace"
HELD_OUT = "--held-out"


class ManyHeldOut(TyperCommand):
    """A command whose ``--held-out`` takes all that follows it, up to the next option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeat the option before every value that follows it, which is how it is declared."""
        spread, taking = [], False
        for k, text in enumerate(args):
            if text == HELD_OUT and (k + 1 == len(args) or args[k + 1].startswith("-")):
                raise typer.BadParameter(f"{HELD_OUT} needs a recording after it")
            if text.startswith("-"):
                taking = text == HELD_OUT
                spread += [] if taking else [text]
            else:
                spread += [HELD_OUT, text] if taking else [text]
        return super().parse_args(ctx, spread)


def trace(
    scenes: Annotated[
        list[Path],
        typer.Argument(
            metavar="SCENE...",
            help="Folder, archive, final_data.pkl or C3D file; several are recordings of one object.",
        ),
    ],
    held_out: Annotated[
        list[Path] | None, typer.Option(metavar="SCENE...", help="Recordings that only the report sees.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            callback=written_as(".json", ".html"),
            help="Write the report to this file: .json, or .html for a page.",
        ),
    ] = None,
    predictions: Annotated[
        Path | None, typer.Option(callback=NPZ_FILE, help="Write the tracks before and after to this npz.")
    ] = None,
    html: Annotated[
        Path | None, typer.Option(callback=HTML_FILE, help="Write the report as a page to this file.")
    ] = None,
    particles: Annotated[int | None, typer.Option(min=50, help="Particles of the twin, about.")] = None,
    mesh: Annotated[
        str | None,
        typer.Option(help="Of a sheet: the mesh of triangles that recorded it, such as 16x15."),
    ] = None,
    processes: Annotated[int | None, typer.Option(min=1, help="Processes that simulate.")] = None,
    time_limit: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            metavar="MINUTES",
            help="After about so long searches are left and the answer is made of what there is (10); 0: never.",
        ),
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Deviation per axis to take for the noise: how well the experiment repeats, say.",
        ),
    ] = None,
    resume: Annotated[
        Path | None, typer.Option(help="Folder that remembers every simulation, to go on after a cut.")
    ] = None,
) -> None:
    """Name the effect that a twin lacks, add it, and report the held-out error before and after."""
    if out is not None and out.suffix.lower() == ".html":
        if html is not None:
            raise typer.BadParameter(f"--out {out} and --html {html} are both the page")
        out, html = None, out
    given = {
        "--out": out,
        "--predictions": predictions,
        "--html": html,
        "--particles": particles,
        "--mesh": mesh,
        "--processes": processes,
        "--time-limit": time_limit,
        "--noise": noise,
        "--resume": resume,
    }
    options = [text for name, value in given.items() if value is not None for text in (name, str(value))]
    if held_out:
        options += [HELD_OUT, *map(str, held_out)]
    become(MODULE, [*options, "--", *map(str, scenes)])
