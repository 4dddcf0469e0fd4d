"""Plastic flow: return mappings in principal Hencky strains, one file a law.

The elastic part of all of them is St. Venant-Kirchhoff in Hencky strain, tau_i = 2 mu eps_i + lambda tr eps, with the
mu and lambda of the body's law: in Hencky strain a return mapping is the one of
small strains (Simo 1992; Klar et al. 2016, section 6.3). A law is a frozen dataclass that knows

    project             Warp function: principal strains and memory before, the same after
    parameters()        up to three numbers that it reads
    initial_memory      the scalar that every particle starts with
    flows, granular     whether it yields at all, and whether it is of grains that part
    name                as in records and reports

and a new one is such a file and a line here.
"""

from __future__ import annotations

from physworld.materials.plastic.drucker_prager import DruckerPrager
from physworld.materials.plastic.identity import Identity
from physworld.materials.plastic.st_venant_kirchhoff import StVenantKirchhoff
from physworld.materials.plastic.von_mises import VonMises

Plasticity = Identity | VonMises | DruckerPrager | StVenantKirchhoff
PLASTICITIES: dict[str, type[Plasticity]] = {
    law.name: law for law in (Identity, VonMises, DruckerPrager, StVenantKirchhoff)
}

__all__ = ["PLASTICITIES", "DruckerPrager", "Identity", "Plasticity", "StVenantKirchhoff", "VonMises"]
