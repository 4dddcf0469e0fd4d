"""The laws of the three body shapes, homogeneous; fields multiply them particle by particle.

Only the ratio of stiffness to density shows in a motion under gravity, ground and prescribed grips; the density is a
prior then, and the stiffness is reported for that density.
"""

from __future__ import annotations

from dataclasses import replace

from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw
from physworld.materials.solid import SolidLaw

__all__ = ["Law", "RodLaw", "SheetLaw", "SolidLaw", "friction_law", "without_friction"]

Law = SolidLaw | SheetLaw | RodLaw


def friction_law(law: Law) -> Law | None:
    """The elastic law whose linear stiffness is the law's friction (force per velocity); None without friction."""
    if isinstance(law, SolidLaw):
        if law.viscosity_pa_s == 0:
            return None
        return SolidLaw(2 * law.viscosity_pa_s, poissons_ratio=0.0, density_kg_m3=law.density_kg_m3)
    tau = law.relaxation_s
    if tau == 0:
        return None
    if isinstance(law, SheetLaw):
        return replace(
            law, membrane_n_m=tau * law.membrane_n_m, bending_n_m=tau * law.bending_n_m, relaxation_s=0.0
        )
    return replace(law, stretching_n=0.0, bending_n_m2=tau * law.bending_n_m2, relaxation_s=0.0)


def without_friction(law: Law) -> Law:
    """The law with its own friction off."""
    if isinstance(law, SolidLaw):
        return replace(law, viscosity_pa_s=0.0)
    return replace(law, relaxation_s=0.0)
