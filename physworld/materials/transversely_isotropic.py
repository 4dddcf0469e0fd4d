"""Transversely isotropic solid: a neo-Hookean matrix and one family of fibres (Holzapfel 2000, section 6.7).

    W = W_neo-Hookean(F) + E_f/8 (a.C a - 1)^2       P = P_neo-Hookean + E_f/2 (a.C a - 1) (F a) (x) a       C = F^T F

a is the fibres' direction in the undeformed body, E_f the modulus that they add to Young's modulus along it at small
strain. The fibres bear compression too. With E_f = 0 it is the neo-Hookean law; with E = 0 it is the fibres alone,
which is how fibres are added to another law.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from physworld.arrays import Array
from physworld.catalogue import Quantity
from physworld.materials import neo_hookean
from physworld.materials.solid import SolidLaw
from physworld.materials.stress import Stress

STRESS = Stress(
    "transversely_isotropic",
    neo_hookean.STRESS.body
    + r"""
    S along[3];
    for (int i = 0; i < 3; ++i)
        along[i] = F[3 * i] * number[0] + F[3 * i + 1] * number[1] + F[3 * i + 2] * number[2];
    const S square = along[0] * along[0] + along[1] * along[1] + along[2] * along[2];
    const S tension = (square - 1.0f) * (c[2] * 0.5f);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) P[3 * i + j] = P[3 * i + j] + tension * along[i] * number[j];
    """,
    infinite_at_inversion=True,
)


@dataclass(frozen=True)
class TransverselyIsotropic(SolidLaw):
    """Neo-Hookean matrix with fibres: see the module's text."""

    name: ClassVar[str] = "transversely_isotropic"
    title: ClassVar[str] = "Neo-Hookean solid with fibres"
    equation: ClassVar[str] = "W = W of neo_hookean + E_f/8 (a.C a - 1)^2"
    use: ClassVar[str] = "fibres along a: wood, muscle, a seam; they bear compression too"
    stress: ClassVar[Stress] = STRESS
    further_moduli: ClassVar[tuple[str, ...]] = ("fibre_modulus",)

    fibre_modulus_pa: Annotated[float, Quantity("Pa", "E_f, added along the fibres", 0.0)] = 0.0
    fibre_azimuth_rad: Annotated[float, Quantity("rad", "fibres' direction at rest, from x towards y")] = 0.0
    fibre_elevation_rad: Annotated[float, Quantity("rad", "the same, from the xy plane towards z")] = 0.0

    @property
    def moduli(self) -> tuple[float, ...]:
        """(mu, lambda, E_f) [Pa]."""
        return (*self.lame, self.fibre_modulus_pa)

    @property
    def numbers(self) -> tuple[float, ...]:
        """Unit vector along the fibres."""
        level = np.cos(self.fibre_elevation_rad)
        return (
            float(level * np.cos(self.fibre_azimuth_rad)),
            float(level * np.sin(self.fibre_azimuth_rad)),
            float(np.sin(self.fibre_elevation_rad)),
        )

    @property
    def wave_speed_m_s(self) -> float:
        """Speed of pressure waves along the fibres [m/s]."""
        mu, lam = self.lame
        return float(np.sqrt((lam + 2 * mu + self.fibre_modulus_pa) / self.density_kg_m3))

    def energy_density(self, F: Array) -> Array:
        """Stored energy [J/m^3] of deformation gradients (..., 3, 3); infinite where J <= 0."""
        stretched = np.sum((F @ np.array(self.numbers)) ** 2, axis=-1)
        energy: Array = (
            neo_hookean.energy_density(F, *self.lame) + self.fibre_modulus_pa / 8 * (stretched - 1) ** 2
        )
        return energy
