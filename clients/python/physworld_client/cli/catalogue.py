"""``physworld catalogue``: laws, effects, metrics, importers and export formats by name, without the service."""

from __future__ import annotations

from typing import Annotated

import typer

from physworld_client.cli.options import Json
from physworld_client.cli.output import stdout
from physworld_schemas.library import Catalogue, Quantity
from physworld_schemas.library import catalogue as installed

PARTS = list(Catalogue.model_fields)


def catalogue(
    part: Annotated[str | None, typer.Argument(help=f"One of {', '.join(PARTS)} [all].")] = None,
    json: Json = False,
) -> None:
    """What this installation knows by name; `physworld effects list SCENE` has the bounds for a recording."""
    if part is not None and part not in PARTS:
        raise typer.BadParameter(f"{part!r} is none of {', '.join(PARTS)}")
    parts = PARTS if part is None else [part]
    if json:
        print(installed().model_dump_json(include=set(parts), indent=2))
        return
    for name in parts:
        entries = getattr(installed(), name)
        width = max((len(entry.name) for entry in entries), default=0)
        stdout.print(name, style="bold")
        for entry in entries:
            _line(f"  {entry.name:<{width}}  {entry.title}")
            if numbers := ", ".join(_numbers(getattr(entry, "parameters", {}))):
                _line(f"  {'':<{width}}  {numbers}")


def _line(text: str) -> None:
    stdout.print(text, markup=False, soft_wrap=True)


def _numbers(parameters: dict[str, Quantity]) -> list[str]:
    return [name if one.unit == "1" else f"{name} [{one.unit}]" for name, one in parameters.items()]
