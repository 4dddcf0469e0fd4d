"""What a registry says of its entries, and how other packages add to it.

A law, an effect or a metric of another package is an entry point of that package::

    [project.entry-points."physworld.laws"]
    foam = "my_package.foam:Foam"

in the group ``physworld.laws``, ``physworld.effects`` or ``physworld.metrics``; its name there is its name in the
registry. The constants of a law carry their units, their limits and a line of help in their annotations::

    youngs_modulus_pa: Annotated[float, Quantity("Pa", "Young's modulus", low=0.0)]

The web process, the SDK and the command line load neither Warp nor the registries. They read descriptions that
``python -m physworld_workers.commands.catalogue`` writes (:mod:`physworld_schemas.library`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib.metadata import entry_points
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

Entry = TypeVar("Entry")


@dataclass(frozen=True)
class Quantity:
    """What a number of a law means.

    Attributes:
        unit: SI unit, "1" for none.
        help: a few words for people.
        low, high: limits of what makes sense; None where there is none.
    """

    unit: str
    help: str
    low: float | None = None
    high: float | None = None


def quantities(law: type) -> dict[str, Quantity]:
    """The constants of a law by name, in the order of its fields.

    Raises:
        TypeError: a constant is not annotated with a Quantity.
    """
    hints = get_type_hints(law, include_extras=True)
    found = {}
    for constant in fields(law):
        hint = hints[constant.name]
        parts = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
        meanings = [part for part in parts if isinstance(part, Quantity)]
        if len(meanings) != 1:
            raise TypeError(
                f"{law.__name__}.{constant.name} has {len(meanings)} annotations Quantity, not one"
            )
        found[constant.name] = meanings[0]
    return found


def with_plugins(group: str, kind: Any, built_in: Mapping[str, Entry]) -> dict[str, Entry]:
    """The entries of a registry, those of other packages after our own.

    Args:
        group: of the entry points.
        kind: what an entry must be: the base class of a class, or the class of an object.
        built_in: our own entries by name.

    Raises:
        TypeError: an entry point is not of that kind, or its name is not the entry's.
        ValueError: a name is taken.
    """
    entries = dict(built_in)
    for point in entry_points(group=group):
        entry = point.load()
        fits = issubclass(entry, kind) if isinstance(entry, type) else isinstance(entry, kind)
        if not fits or entry.name != point.name:
            raise TypeError(
                f"{group}: {point.value} is not of the right kind, or its name is not {point.name!r}"
            )
        if point.name in entries:
            raise ValueError(f"{group}: {point.value} is called {point.name!r}, which is taken")
        entries[point.name] = entry
    return entries
