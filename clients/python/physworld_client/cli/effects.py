"""``physworld effects list``: the registry of effects, printed by the engine without the service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli.fit import become

MODULE = "physworld_workers.commands.effects"

effects = typer.Typer(no_args_is_help=True, help="Effects that a twin may have beside its declared physics.")


@effects.command("list")
def effects_list(
    scene: Annotated[
        Path | None, typer.Argument(help="Bounds for this scene's body [a beam, a sheet and a rope].")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Names, kinds, strengths with units and bounds, equations; needs no service."""
    become(MODULE, [*(["--json"] if json else []), *([] if scene is None else ["--", str(scene)])])
