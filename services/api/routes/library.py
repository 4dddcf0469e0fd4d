"""Read-only libraries: the constitutive laws and the effects that this version of the engine knows."""

from __future__ import annotations

from fastapi import APIRouter

from schemas.base import Page
from schemas.library import Effect, Material
from services.api.errors import documented

router = APIRouter(tags=["library"], responses=documented(401, 403))

_MATERIALS = [
    Material(
        name="neo_hookean",
        title="Compressible neo-Hookean solid",
        energy="W(F) = mu/2 (tr F^T F - 3 - 2 ln J) + lambda/2 (ln J)^2",
        parameters={
            "youngs_modulus_pa": "Pa",
            "poissons_ratio": "1",
            "viscosity_pa_s": "Pa s",
            "density_kg_m3": "kg/m^3",
        },
    )
]


@router.get("/materials")
def list_materials() -> Page[Material]:
    """Constitutive laws by the name that `FitConfig.material` takes."""
    return Page(data=_MATERIALS)


@router.get("/effects")
def list_effects() -> Page[Effect]:
    """Effects that a residual can be traced to; none in this version."""
    return Page(data=[])
