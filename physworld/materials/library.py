"""Every law by name: what a scene may declare, a calibration may choose and an archive may hold."""

from __future__ import annotations

from dataclasses import fields

from physworld.materials.drucker_prager_elastic import DruckerPragerElastic
from physworld.materials.fixed_corotated import FixedCorotated
from physworld.materials.hencky import Hencky
from physworld.materials.laws import Law
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import OrthotropicSheetLaw, SheetLaw
from physworld.materials.solid import SolidLaw
from physworld.materials.st_venant_kirchhoff import StVenantKirchhoff
from physworld.materials.transversely_isotropic import TransverselyIsotropic

SOLID_LAWS: dict[str, type[SolidLaw]] = {
    law.name: law
    for law in (
        SolidLaw, FixedCorotated, StVenantKirchhoff, Hencky, DruckerPragerElastic, TransverselyIsotropic,
    )
}  # fmt: skip
SHEET_LAWS: dict[str, type[SheetLaw]] = {law.name: law for law in (SheetLaw, OrthotropicSheetLaw)}
ROD_LAWS: dict[str, type[RodLaw]] = {RodLaw.name: RodLaw}
_OF_DIMENSION: dict[int, dict[str, type]] = {1: ROD_LAWS, 2: SHEET_LAWS, 3: SOLID_LAWS}


def law_class(name: str, dimension: int) -> type[Law]:
    """The class of a law for bodies of ``dimension`` 1, 2 or 3.

    Args:
        name: as in the registries; archives of version 0.1 name the class (``SolidLaw``) instead.

    Raises:
        ValueError: there is no such law; the message lists those of that dimension.
    """
    laws = _OF_DIMENSION[dimension]
    name = {law.__name__: key for key, law in laws.items()}.get(name, name)
    if name not in laws:
        raise ValueError(f"no law {name!r} for a body of dimension {dimension}; there are {sorted(laws)}")
    return laws[name]


def with_law(law: Law, name: str) -> Law:
    """The law called ``name`` for the same shape of body, with every number that the two share taken from ``law``.

    Raises:
        ValueError: there is no such law for that shape.
    """
    dimension = 3 if isinstance(law, SolidLaw) else 2 if isinstance(law, SheetLaw) else 1
    target = law_class(name, dimension)
    shared = {f.name for f in fields(target)} & {f.name for f in fields(law)}
    return target(**{key: getattr(law, key) for key in sorted(shared)})
