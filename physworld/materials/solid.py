"""What the laws of solids share: linear elastic constants, friction and density.

A law is a subclass with a name, its stress (native text) and its energy density (numpy, for ledgers and tests); what
else it needs becomes a field.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from physworld.arrays import Array
from physworld.catalogue import Quantity
from physworld.materials.laws import Law
from physworld.materials.stress import Stress


@dataclass(frozen=True)
class SolidLaw(Law):
    """Law of a solid that is isotropic at small strain, but for further moduli.

    Attributes:
        stress: text of the first Piola-Kirchhoff stress.
        further_moduli: names of the moduli after mu and lambda.
    """

    dimension: ClassVar[int] = 3
    friction_name: ClassVar[str] = "viscosity_pa_s"
    strain_orders: ClassVar[tuple[tuple[int, ...], ...]] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    stress: ClassVar[Stress]
    further_moduli: ClassVar[tuple[str, ...]] = ()

    youngs_modulus_pa: Annotated[float, Quantity("Pa", "E, Young's modulus at small strain", 0.0)]
    poissons_ratio: Annotated[float, Quantity("1", "nu, Poisson's ratio at small strain", -1.0, 0.5)] = 0.35
    viscosity_pa_s: Annotated[float, Quantity("Pa s", "Kelvin-Voigt eta: Cauchy stress + 2 eta d", 0.0)] = 0.0
    density_kg_m3: Annotated[float, Quantity("kg/m^3", "mass per volume", 0.0)] = 1000.0

    @property
    def density(self) -> float:
        """Mass per volume [kg/m^3]."""
        return self.density_kg_m3

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

    @property
    def columns(self) -> dict[str, float]:
        """The moduli [Pa], and the viscosity [Pa s]."""
        names = ("mu", "lambda", *self.further_moduli, "viscosity")
        return dict(zip(names, (*self.moduli, self.viscosity_pa_s), strict=True))

    @property
    def stiffness_columns(self) -> tuple[int, ...]:
        """All: a factor on the stiffness multiplies the viscosity too."""
        return tuple(range(len(self.moduli) + 1))

    @property
    def shape(self) -> tuple[tuple[float, ...], ...]:
        """The law's other numbers."""
        return (self.numbers,)

    @property
    def friction_law(self) -> Law | None:
        """A solid whose linear stiffness is that of Newtonian friction; any law of solids has the same."""
        from physworld.materials.neo_hookean import NeoHookean  # it is itself a law of solids

        if self.viscosity_pa_s == 0:
            return None
        return NeoHookean(2 * self.viscosity_pa_s, poissons_ratio=0.0, density_kg_m3=self.density_kg_m3)

    def contact_stiffness(self, cell_m: float) -> tuple[float, float]:
        """Of pressure and shear across a cell of ``cell_m`` [Pa/m]."""
        mu, lam = self.lame
        return (lam + 2 * mu) / cell_m, mu / cell_m

    def energy_of(self, derivatives: Array) -> Array:
        """Stored energy [J/m^3] of transposed displacement gradients (..., 3, 3)."""
        return self.energy_density(np.eye(3) + np.swapaxes(derivatives, -1, -2))

    @abstractmethod
    def energy_density(self, F: Array) -> Array:
        """Stored energy [J/m^3] of deformation gradients (..., 3, 3), without the stiffness field's factor."""
