"""The law of a solid: linear elastic constants, friction and density, and the stored energy that extends them.

:class:`SolidLaw` is the common base of all laws of solids, and itself the neo-Hookean one. A law overrides its name,
its stress (native text) and its energy density (numpy, for ledgers and tests); what else it needs becomes a field.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from physworld.arrays import Array
from physworld.materials import neo_hookean
from physworld.materials.stress import Stress


@dataclass(frozen=True)
class SolidLaw:
    """Compressible neo-Hookean solid: see :mod:`physworld.materials.neo_hookean`; the base of the other laws.

    Attributes:
        youngs_modulus_pa, poissons_ratio: linear elastic constants at small strain.
        viscosity_pa_s: Kelvin-Voigt eta, Cauchy stress + 2 eta d.
        density_kg_m3: mass per volume.
    """

    name: ClassVar[str] = "neo_hookean"
    stress: ClassVar[Stress] = neo_hookean.STRESS
    further_moduli: ClassVar[tuple[str, ...]] = ()  # names of the moduli after mu and lambda

    youngs_modulus_pa: float
    poissons_ratio: float = 0.35
    viscosity_pa_s: float = 0.0
    density_kg_m3: float = 1000.0

    @property
    def lame(self) -> tuple[float, float]:
        """(mu, lambda) [Pa]."""
        e, nu = self.youngs_modulus_pa, self.poissons_ratio
        return e / (2 * (1 + nu)), e * nu / ((1 + nu) * (1 - 2 * nu))

    @property
    def moduli(self) -> tuple[float, ...]:
        """Every modulus in which the stress is linear [Pa]: c[] of the stress text; (mu, lambda) unless overridden."""
        return self.lame

    @property
    def numbers(self) -> tuple[float, ...]:
        """The law's other numbers: number[] of the stress text."""
        return ()

    @property
    def wave_speed_m_s(self) -> float:
        """Speed of pressure waves [m/s]."""
        mu, lam = self.lame
        return float(np.sqrt((lam + 2 * mu) / self.density_kg_m3))

    def energy_density(self, F: Array) -> Array:
        """Stored energy [J/m^3] of deformation gradients (..., 3, 3), without the stiffness field's factor."""
        return neo_hookean.energy_density(F, *self.lame)
