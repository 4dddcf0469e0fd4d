"""The law of ropes and rods, straight at rest.

    W = EA/2 (|x'| - 1)^2 + B/2 |k|^2       k = x' x x'' / |x'|^3       B = EI

The rod is isotropic about its axis. Its twist decouples from the centre line but for the two ends of a piece that is
held at both (Bergou et al. 2008): there GJ = ``torsion_ratio`` EI counts, as :mod:`physworld.engine.thin.twist` has it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from physworld.arrays import Array
from physworld.catalogue import Quantity
from physworld.materials.laws import Law


@dataclass(frozen=True)
class RodLaw(Law):
    """Rope or rod, straight at rest; the density is per length.

    The default of ``torsion_ratio``, 1 / (1 + nu), is that of a round section with nu = 0.3. It counts where grips
    hold the section at two places; 0: no twist is carried.
    """

    dimension: ClassVar[int] = 1
    friction_name: ClassVar[str] = "relaxation_s"
    strain_orders: ClassVar[tuple[tuple[int, ...], ...]] = ((1,), (2,))

    name: ClassVar[str] = "rod"
    title: ClassVar[str] = "Rope or rod, straight at rest"
    equation: ClassVar[str] = "W = EA/2 (|x'| - 1)^2 + B/2 |k|^2 + GJ/2 (Theta/L)^2"
    use: ClassVar[str] = "ropes, cables, rods"

    stretching_n: Annotated[float, Quantity("N", "EA, force per strain", 0.0)]
    bending_n_m2: Annotated[float, Quantity("N m^2", "B = EI, bending stiffness", 0.0)]
    relaxation_s: Annotated[float, Quantity("s", "Kelvin-Voigt time tau of bending", 0.0)] = 0.0
    density_kg_m: Annotated[float, Quantity("kg/m", "mass per length", 0.0)] = 0.05
    torsion_ratio: Annotated[float, Quantity("1", "GJ / EI, torsional over bending stiffness", 0.0)] = (
        1.0 / 1.3
    )

    @property
    def density(self) -> float:
        """Mass per length [kg/m]."""
        return self.density_kg_m

    @property
    def torsion_n_m2(self) -> float:
        """GJ, torsional stiffness [N m^2]."""
        return self.torsion_ratio * self.bending_n_m2

    @property
    def wave_speed_m_s(self) -> float:
        """Speed of stretch waves [m/s]."""
        return float(np.sqrt(self.stretching_n / self.density_kg_m))

    @property
    def columns(self) -> dict[str, float]:
        """EA [N], B [N m^2] and the relaxation time [s]."""
        return {
            "stretching": self.stretching_n,
            "bending": self.bending_n_m2,
            "relaxation": self.relaxation_s,
        }

    @property
    def stiffness_columns(self) -> tuple[int, ...]:
        """EA and B: the friction is in theirs."""
        return 0, 1

    @property
    def shape(self) -> tuple[tuple[float, ...], ...]:
        """Nothing beside the columns."""
        return ()

    @property
    def friction_law(self) -> Law | None:
        """The friction of bending; a rod's stretch has none."""
        if self.relaxation_s == 0:
            return None
        return replace(
            self, stretching_n=0.0, bending_n_m2=self.relaxation_s * self.bending_n_m2, relaxation_s=0.0
        )

    def contact_stiffness(self, cell_m: float) -> tuple[float, float]:
        """Of the body's fastest waves over a cell of ``cell_m``, in all directions."""
        rate = self.wave_speed_m_s / cell_m
        return self.density * rate**2, self.density * rate**2

    def energy_of(self, derivatives: Array) -> Array:
        """Stored energy [J/m] of first and second derivatives of the centre line, (..., 2, 3)."""
        return self.energy_density(*rod_strains(derivatives))

    def energy_density(self, strain: Array, curvature: Array) -> Array:
        """Stored energy [J/m] of strains |x'| - 1, (...), and curvature vectors [1/m], (..., 3)."""
        energy: Array = 0.5 * self.stretching_n * strain**2 + 0.5 * self.bending_n_m2 * np.sum(
            curvature**2, axis=-1
        )
        return energy


def rod_strains(derivatives: Array) -> tuple[Array, Array]:
    """Strain |x'| - 1, (...), and curvature vector x' x x'' / |x'|^3 [1/m], (..., 3).

    Args:
        derivatives: x' (no unit) and x'' [1/m] of the centre line, (..., 2, 3).
    """
    tangent, bend = derivatives[..., 0, :], derivatives[..., 1, :]
    length = np.linalg.norm(tangent, axis=-1)
    return length - 1, np.cross(tangent, bend) / length[..., None] ** 3
