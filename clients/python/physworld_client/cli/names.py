"""Arguments that name an object: by its id, the beginning of its id, or its name; the SDK looks it up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import typer

from physworld_client.client import Client
from physworld_client.names import WITH_NAMES


@dataclass(frozen=True)
class Named:
    """Marks an argument as the name of one object of a resource; ``options.connected`` looks it up."""

    resource: str


def help_of(resource: str) -> str:
    """How one object of a resource may be named, for the help of an argument."""
    if resource == "models":
        return "Name, or the beginning of one."
    return f"Id, the beginning of one{', or a name' if resource in WITH_NAMES else ''}."


def one_of(resource: str) -> Any:
    """The type of an argument that names one object of a resource."""
    return Annotated[str, typer.Argument(help=help_of(resource)), Named(resource)]


def found(client: Client, resource: str, given: str) -> str:
    """The id (of a model: the name) of what was named.

    Raises:
        PhysWorldError: nothing is called that, or several are.
    """
    identifier: str = getattr(client, resource).id_of(given)
    return identifier
