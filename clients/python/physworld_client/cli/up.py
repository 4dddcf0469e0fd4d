"""``physworld up``: the embedded service in the foreground.

This process becomes the supervisor, so that Ctrl-C, a signal or a kill reaches exactly one process, and its
exit code is the command's. The supervisor prints the addresses of API, docs and dashboard, and where the API
key is.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from physworld_client.cli import service
from physworld_client.errors import PhysWorldError


def up(
    data: Annotated[Path | None, typer.Option(help="Data folder [PHYSWORLD_DATA_DIR].")] = None,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Simulation workers.")] = 2,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the API; 0 takes a free one.")] = 0,
) -> None:
    """Start the whole service on this machine; Ctrl-C stops it."""
    require_service_code()
    command = service.embedded_command(service.data_folder(data), workers, port)
    sys.stdout.flush()
    os.execv(command[0], command)


def require_service_code() -> None:
    """Raises PhysWorldError where only the client is installed."""
    if (
        importlib.util.find_spec("physworld_services") is None
        or importlib.util.find_spec("physworld_services.embedded") is None
    ):
        raise PhysWorldError(
            "the service is not installed here, only its client: install the distribution physworld with the "
            "extras api, sim and train, or give --url of a running service"
        )
