"""Constitutive parameters of the three body shapes, homogeneous; fields multiply them particle by particle.

Only the ratio of stiffness to density shows in a motion under gravity, ground and prescribed grips; the density is a
prior then, and the stiffness is reported for that density.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class SolidLaw:
    """Compressible neo-Hookean solid: W = mu/2 (tr F^T F - 3 - 2 ln J) + lambda/2 (ln J)^2.

    Attributes:
        youngs_modulus_pa, poissons_ratio: linear elastic constants at small strain.
        viscosity_pa_s: Kelvin-Voigt eta, Cauchy stress + 2 eta d.
        density_kg_m3: mass per volume.
    """

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
    def wave_speed_m_s(self) -> float:
        """Speed of pressure waves [m/s]."""
        mu, lam = self.lame
        return float(np.sqrt((lam + 2 * mu) / self.density_kg_m3))


@dataclass(frozen=True)
class SheetLaw:
    """Thin isotropic sheet, flat at rest.

    Attributes:
        membrane_n_m: h E / (1 - nu^2), in-plane stiffness [N/m].
        bending_n_m: D, bending stiffness [N m].
        poissons_ratio: of the sheet.
        relaxation_s: Kelvin-Voigt time tau of stretch and bending.
        density_kg_m2: mass per area.
    """

    membrane_n_m: float
    bending_n_m: float
    poissons_ratio: float = 0.3
    relaxation_s: float = 0.0
    density_kg_m2: float = 0.3

    @property
    def wave_speed_m_s(self) -> float:
        """Speed of in-plane pressure waves [m/s]."""
        return float(np.sqrt(self.membrane_n_m / self.density_kg_m2))


@dataclass(frozen=True)
class RodLaw:
    """Rope or rod, straight at rest.

    Attributes:
        stretching_n: EA, force per strain [N].
        bending_n_m2: B = EI, bending stiffness [N m^2].
        relaxation_s: Kelvin-Voigt time tau of bending.
        density_kg_m: mass per length.
    """

    stretching_n: float
    bending_n_m2: float
    relaxation_s: float = 0.0
    density_kg_m: float = 0.05

    @property
    def wave_speed_m_s(self) -> float:
        """Speed of stretch waves [m/s]."""
        return float(np.sqrt(self.stretching_n / self.density_kg_m))


Law = SolidLaw | SheetLaw | RodLaw


def friction_law(law: Law) -> Law | None:
    """The elastic law whose linear stiffness is the law's friction (force per velocity); None without friction."""
    if isinstance(law, SolidLaw):
        if law.viscosity_pa_s == 0:
            return None
        return replace(law, youngs_modulus_pa=2 * law.viscosity_pa_s, poissons_ratio=0.0, viscosity_pa_s=0.0)
    tau = law.relaxation_s
    if tau == 0:
        return None
    if isinstance(law, SheetLaw):
        return replace(
            law, membrane_n_m=tau * law.membrane_n_m, bending_n_m=tau * law.bending_n_m, relaxation_s=0.0
        )
    return replace(law, stretching_n=0.0, bending_n_m2=tau * law.bending_n_m2, relaxation_s=0.0)
