"""``physworld datasets export``: the episodes of a dataset for other tools."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from physworld_client.cli import service
from physworld_client.cli.options import Data, Token, Url
from physworld_client.cli.output import stderr, stdout


class ExportFormat(StrEnum):
    """The forms that episodes can be written in."""

    npz = "npz"
    ply = "ply"
    lerobot = "lerobot"


def export(
    dataset_id: str,
    format: Annotated[
        ExportFormat, typer.Option("--format", "-f", help="One npz an episode; PLY a frame; LeRobot v3.")
    ] = ExportFormat.npz,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="New or empty folder [./ID-FORMAT].")
    ] = None,
    episodes: Annotated[int | None, typer.Option(min=1, help="Only the first so many.")] = None,
    points: Annotated[
        int | None, typer.Option(min=1, help="At most so many particles a frame [ply: all, lerobot: 256].")
    ] = None,
    url: Url = None,
    token: Token = None,
    data: Data = None,
) -> None:
    """Write the episodes of a sealed dataset as npz, PLY or LeRobot v3."""
    folder = out or Path(f"{dataset_id}-{format.value}")
    with service.connect(url, token, data) as client, Progress(console=stderr, transient=True) as shown:
        task = shown.add_task("episodes", total=None)

        def tell(done: int, total: int) -> None:
            shown.update(task, completed=done, total=total)

        client.datasets.export(
            dataset_id, folder, format=format.value, episodes=episodes, points=points, on_progress=tell
        )
    stdout.print(f"{folder.absolute()}", soft_wrap=True)
