"""The commands and their common end: an error is one clear line on standard error and an exit code.

Exit codes: 0 done, 1 the work failed or the service said no, 2 the command line is wrong, 3 ``up`` on a data
folder where the service already runs, 130 interrupted (Typer's).
"""

from __future__ import annotations

import os
import signal
import sys
from importlib.metadata import version as installed_version
from types import FrameType
from typing import Annotated, NoReturn

import typer
from pydantic import ValidationError

import physworld_client.cli.actions
import physworld_client.cli.loop
import physworld_client.cli.registry
import physworld_client.cli.starts  # noqa: F401  (adds commands to the groups)
from physworld_client.cli import (
    catalogue,
    check,
    effects,
    fit,
    importing,
    lists,
    predict,
    run,
    running,
    splat,
    trace,
    up,
    video,
)
from physworld_client.cli.options import connected
from physworld_client.cli.output import stderr
from physworld_client.errors import PhysWorldError

app = typer.Typer(
    name="physworld",
    help="From a recording of a deformable object to a world model.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command("up")(up.up)
app.command("run")(run.run)
app.command("check")(check.check)
app.command("status")(running.status)
app.command("logs")(running.logs)
app.command("down")(running.down)
app.command("fit")(fit.fit)
app.command("trace", cls=trace.ManyHeldOut)(trace.trace)
connected(app, "rollout")(predict.rollout)
connected(app, "plan")(predict.plan)
app.command("video")(video.video)
app.command("splat")(splat.splat)
app.command("import")(importing.import_recording)
app.command("catalogue")(catalogue.catalogue)
app.add_typer(effects.effects, name="effects")
for name, group in lists.GROUPS.items():
    app.add_typer(group, name=name)


@app.command("version")
def version() -> None:
    """Print the version of the client."""
    print(installed_version("physworld-client"))


def _version(asked: bool) -> None:
    if asked:
        version()
        raise typer.Exit


@app.callback()
def physworld(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and leave.")
    ] = False,
) -> None:
    """From a recording of a deformable object to a world model."""


def main() -> None:
    """Entry point of the command ``physworld``."""
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        app(standalone_mode=True)
    except PhysWorldError as error:
        stderr.print(f"error: {error}", markup=False, highlight=False, soft_wrap=True)
        sys.exit(1)
    except ValidationError as error:  # what was given makes no request
        faults = [(".".join(map(str, fault["loc"])), fault["msg"]) for fault in error.errors()]
        said = "; ".join(f"{place}: {message}" if place else message for place, message in faults)
        stderr.print(f"error: {said}", markup=False, highlight=False, soft_wrap=True)
        sys.exit(2)
    except BrokenPipeError:
        # The reader of our output has left (``physworld jobs list | head``): not an error of ours.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    """SIGTERM ends a command the way Ctrl-C does: jobs are cancelled and the service is stopped."""
    raise KeyboardInterrupt
