"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Url = Annotated[str | None, typer.Option("--url", help="Address of a running service [PHYSWORLD_URL].")]
Token = Annotated[str | None, typer.Option("--token", help="API key for --url [PHYSWORLD_TOKEN].")]
Data = Annotated[
    Path | None, typer.Option("--data", help="Data folder of the embedded service [PHYSWORLD_DATA_DIR].")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Limit = Annotated[int, typer.Option("--limit", "-n", min=1, help="At most so many, newest first.")]
