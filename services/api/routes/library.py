"""Read-only libraries: the constitutive laws and the effects that this version of the engine knows."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from fastapi import APIRouter
from pydantic import TypeAdapter

from physworld_schemas.base import Page
from physworld_schemas.library import Effect, Material
from physworld_services.api.errors import documented

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
    ),
    Material(
        name="elastic_sheet",
        title="Thin isotropic sheet, flat at rest",
        energy="W(e, k) = C/2 (nu (tr e)^2 + (1 - nu) e:e) + D/2 (nu (tr k)^2 + (1 - nu) k:k)",
        parameters={
            "membrane_n_m": "N/m",
            "bending_n_m": "N m",
            "poissons_ratio": "1",
            "relaxation_s": "s",
            "density_kg_m2": "kg/m^2",
        },
    ),
    Material(
        name="elastic_rod",
        title="Rope or rod, straight at rest",
        energy="W(x', k, Theta) = EA/2 (|x'| - 1)^2 + B/2 |k|^2 + GJ/2 (Theta/L)^2",
        parameters={
            "stretching_n": "N",
            "bending_n_m2": "N m^2",
            "relaxation_s": "s",
            "density_kg_m": "kg/m",
            "torsion_ratio": "1",
        },
    ),
]


@router.get("/materials")
def list_materials() -> Page[Material]:
    """Constitutive laws that a fit chooses from by the body's shape: solid, sheet, rod."""
    return Page(data=_MATERIALS)


@router.get("/effects")
def list_effects() -> Page[Effect]:
    """Effects that a residual can be traced to, with their strengths' units."""
    return Page(data=known_effects())


@cache
def known_effects() -> list[Effect]:
    """The registry, as the file beside this package has it (``physworld_workers.commands.effects_wire`` writes it)."""
    return TypeAdapter(list[Effect]).validate_json((Path(__file__).parents[1] / "effects.json").read_bytes())
