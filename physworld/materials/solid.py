"""The law of a solid: linear elastic constants, friction and density, and the stored energy that extends them.

:class:`SolidLaw` is the common base of all laws of solids, and itself the neo-Hookean one. A law overrides its name,
its stress (native text) and its energy density (numpy, for ledgers and tests); what else it needs becomes a field.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from physworld.arrays import Array
from physworld.catalogue import Quantity
from physworld.materials import neo_hookean
from physworld.materials.stress import Stress


@dataclass(frozen=True)
class SolidLaw:
    """Compressible neo-Hookean solid: see :mod:`physworld.materials.neo_hookean`; the base of the other laws.

    Every law says of itself its ``name``, a ``title``, its ``equation`` and its ``use``: what it is for.
    """

    dimension: ClassVar[int] = 3

    name: ClassVar[str] = "neo_hookean"
    title: ClassVar[str] = "Compressible neo-Hookean solid"
    equation: ClassVar[str] = "W = mu/2 (tr C - 3 - 2 ln J) + lambda/2 (ln J)^2"
    use: ClassVar[str] = "rubber, foam, soft toys; the default"
    stress: ClassVar[Stress] = neo_hookean.STRESS
    further_moduli: ClassVar[tuple[str, ...]] = ()  # names of the moduli after mu and lambda

    youngs_modulus_pa: Annotated[float, Quantity("Pa", "E, Young's modulus at small strain", 0.0)]
    poissons_ratio: Annotated[float, Quantity("1", "nu, Poisson's ratio at small strain", -1.0, 0.5)] = 0.35
    viscosity_pa_s: Annotated[float, Quantity("Pa s", "Kelvin-Voigt eta: Cauchy stress + 2 eta d", 0.0)] = 0.0
    density_kg_m3: Annotated[float, Quantity("kg/m^3", "mass per volume", 0.0)] = 1000.0

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
