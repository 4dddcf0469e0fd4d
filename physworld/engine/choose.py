"""Which formulation integrates a body, and why.

The total Lagrangian form does not damp, so it is taken wherever it can describe the motion. The updated Lagrangian
form is taken where material flows, parts, or touches itself: a flow law says so, or the scene does. A sheet or rod has
only the total form, and touches itself there (:mod:`physworld.engine.thin.self_contact`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from physworld.errors import SceneUnsupported
from physworld.materials.plastic import Identity, Plasticity

FormulationName = Literal["total_lagrangian", "updated_lagrangian"]
FORMULATIONS: tuple[FormulationName, ...] = ("total_lagrangian", "updated_lagrangian")
_DECLARED = {"self_contact": "the body touches itself", "topology_change": "the body parts or merges"}


@dataclass(frozen=True)
class Choice:
    """A formulation and why it was taken."""

    formulation: FormulationName
    reason: str


def choose_formulation(
    dimension: int,
    declared: dict[str, Any],
    plasticity: Plasticity | None = None,
    asked: str = "auto",
) -> Choice:
    """The formulation for a body.

    Args:
        dimension: 3 for a solid, 2 for a sheet, 1 for a rod.
        declared: the scene's declaration; ``body.self_contact`` and ``body.topology_change`` are read.
        plasticity: the body's flow law.
        asked: "auto", or the name of a formulation, which is then taken.

    Raises:
        ValueError: ``asked`` is no formulation.
        SceneUnsupported: the updated Lagrangian form is asked for a sheet or a rod, or a flow law for the total one.
    """
    if asked != "auto" and asked not in FORMULATIONS:
        raise ValueError(f"no formulation is called {asked!r}; there are {list(FORMULATIONS)} and 'auto'")
    flows = plasticity is not None and not isinstance(plasticity, Identity)
    if asked == "updated_lagrangian" and dimension != 3:
        raise SceneUnsupported(
            f"the updated Lagrangian form integrates solids, the body has dimension {dimension}"
        )
    if plasticity is not None and (asked == "total_lagrangian" or dimension != 3):
        raise SceneUnsupported(
            f"{plasticity.name} flow needs the updated Lagrangian form and a solid; asked was {asked} for a body of "
            f"dimension {dimension} (the plasticity effect covers small plastic strains)"
        )
    if asked != "auto":
        return Choice(asked, "asked for")  # type: ignore[arg-type]
    if dimension != 3:
        return Choice("total_lagrangian", f"a body of dimension {dimension} has no other form")
    if flows:
        return Choice("updated_lagrangian", f"its flow law is {plasticity.name}")  # type: ignore[union-attr]
    if plasticity is not None:
        return Choice("updated_lagrangian", "its law is that of a return mapping")
    body = declared.get("body") or {}
    for key, reason in _DECLARED.items():
        if body.get(key):
            return Choice("updated_lagrangian", f"the scene declares {key}: {reason}")
    return Choice("total_lagrangian", "an elastic solid: no transfers, so none of their damping")
