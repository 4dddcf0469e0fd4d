"""What people call an object on the command line: its id, the beginning of its id, or its name.

An id is taken as it is. Anything else is looked for among the newest ``MOST`` objects: an exact name counts before the
beginning of an id or of a model's name. What fits several is refused, with their ids.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import islice
from typing import Annotated, Any

import typer

from physworld_client.client import Client
from physworld_client.errors import PhysWorldError
from physworld_schemas.ids import PREFIXES

MOST = 5000
PAGE = 200
SHOWN = 4
SINGULAR = {
    "scenes": "scene",
    "checks": "check",
    "fits": "fit",
    "traces": "trace",
    "datasets": "dataset",
    "models": "model",
    "assessments": "assessment",
    "loops": "loop",
    "rollouts": "rollout",
    "plans": "plan",
    "videos": "video",
    "jobs": "job",
    "keys": "key",
}
"""The client's resources, and what one of each is called."""
WITH_NAMES = frozenset({"scenes", "keys"})
_MODEL = r"[a-z0-9][a-z0-9._-]*"
_ULID = r"[0-9A-HJKMNP-TV-Z]{26}"


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
    what = SINGULAR[resource]
    named = "job" if what == "loop" else what  # a loop's id is its job's
    prefix = f"{PREFIXES[named]}_" if named in PREFIXES else ""
    if re.fullmatch(prefix + _ULID, given) if prefix else not re.fullmatch(_MODEL, given):
        return given  # an id; or what can be no model's name, which the request itself will say
    listed = islice(getattr(client, resource).list(limit=PAGE).auto_paging_iter(), MOST)
    known: list[tuple[str, str]] = [
        (item.name, item.name)
        if resource == "models"
        else (item.id, item.name if resource in WITH_NAMES else "")
        for item in listed
    ]
    exact = [identifier for identifier, name in known if given in (identifier, name)]
    begun = [identifier for identifier, _ in known if _begins(identifier, given, prefix)]
    fitting = exact or begun
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        looked = f" among the newest {MOST}" if len(known) == MOST else ""
        raise PhysWorldError(
            f"no {what} is called {given!r} and no id begins so{looked}: see `physworld {resource} list`"
        )
    more = f" and {len(fitting) - SHOWN} more" if len(fitting) > SHOWN else ""
    raise PhysWorldError(f"{len(fitting)} {resource} fit {given!r}: {', '.join(fitting[:SHOWN])}{more}")


def _begins(identifier: str, given: str, prefix: str) -> bool:
    """Whether an id begins so, with or without what all ids of its kind begin with; letters of either case."""
    whole, begun = identifier.lower(), given.lower()
    return bool(begun) and (whole.startswith(begun) or (bool(prefix) and whole.startswith(prefix + begun)))
