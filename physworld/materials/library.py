"""Every elastic law by name: what a calibration may choose and an archive may hold.

A new one is a file beside this one and a line here; other packages add theirs (:mod:`physworld.catalogue`).
"""

from __future__ import annotations

from dataclasses import fields

from physworld.catalogue import with_plugins
from physworld.materials.cable import CableLaw
from physworld.materials.fixed_corotated import FixedCorotated
from physworld.materials.hencky import DruckerPragerElastic, Hencky
from physworld.materials.laws import Law
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import OrthotropicSheetLaw, SheetLaw
from physworld.materials.solid import SolidLaw
from physworld.materials.st_venant_kirchhoff import StVenantKirchhoff
from physworld.materials.transversely_isotropic import TransverselyIsotropic

_BUILT_IN: tuple[type[Law], ...] = (
    NeoHookean,
    FixedCorotated,
    StVenantKirchhoff,
    Hencky,
    DruckerPragerElastic,
    TransverselyIsotropic,
    SheetLaw,
    OrthotropicSheetLaw,
    RodLaw,
    CableLaw,
)
ELASTIC_LAWS: dict[str, type[Law]] = with_plugins("physworld.laws", Law, {law.name: law for law in _BUILT_IN})
_OLD_NEO_HOOKEAN = "SolidLaw"  # in archives of version 0.1
SOLID_LAWS = {name: law for name, law in ELASTIC_LAWS.items() if issubclass(law, SolidLaw)}


def law_class(name: str, dimension: int) -> type[Law]:
    """The class of a law for bodies of ``dimension`` 1, 2 or 3.

    Args:
        name: as in the registries; archives of version 0.1 name the class (``SolidLaw``) instead.

    Raises:
        ValueError: there is no such law; the message lists those of that dimension.
    """
    laws = {name: law for name, law in ELASTIC_LAWS.items() if law.dimension == dimension}
    name = {_OLD_NEO_HOOKEAN: NeoHookean.name, **{law.__name__: key for key, law in laws.items()}}.get(
        name, name
    )
    if name not in laws:
        raise ValueError(f"no law {name!r} for a body of dimension {dimension}; there are {sorted(laws)}")
    return laws[name]


def with_law(law: Law, name: str) -> Law:
    """The law called ``name`` for the same shape of body, with every number that the two share taken from ``law``.

    Raises:
        ValueError: there is no such law for that shape.
    """
    target = law_class(name, law.dimension)
    shared = {f.name for f in fields(target)} & {f.name for f in fields(law)}
    return target(**{key: getattr(law, key) for key in sorted(shared)})
