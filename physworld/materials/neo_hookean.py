"""Compressible neo-Hookean solid with a logarithmic volumetric term (Bonet and Wood 2008, section 6.4.3).

    W = mu/2 (tr F^T F - 3 - 2 ln J) + lambda/2 (ln J)^2
    P = mu (F - F^-T) + lambda ln(J) F^-T

The default for rubber, foam and soft toys: the energy is infinite at J = 0, so matter does not turn inside out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from physworld.arrays import Array
from physworld.materials.solid import SolidLaw
from physworld.materials.stress import Stress

STRESS = Stress(
    "neo_hookean",
    r"""
    const S inverse = lane::inverse(J);
    const S pressure = (lane::log(J) * c[1] - c[0]) * inverse;
    for (int k = 0; k < 9; ++k) P[k] = F[k] * c[0] + cof[k] * pressure;
    """,
    infinite_at_inversion=True,
)


def energy_density(F: Array, mu: float, lam: float) -> Array:
    """Stored energy [J/m^3] of deformation gradients (..., 3, 3); infinite where J <= 0."""
    J = np.linalg.det(F)
    log_j = np.log(np.where(J > 0, J, 1.0))
    W = 0.5 * mu * (np.sum(F**2, axis=(-2, -1)) - 3 - 2 * log_j) + 0.5 * lam * log_j**2
    return np.where(J > 0, W, np.inf)


@dataclass(frozen=True)
class NeoHookean(SolidLaw):
    """Compressible neo-Hookean solid: see the module's text."""

    name: ClassVar[str] = "neo_hookean"
    title: ClassVar[str] = "Compressible neo-Hookean solid"
    equation: ClassVar[str] = "W = mu/2 (tr C - 3 - 2 ln J) + lambda/2 (ln J)^2"
    use: ClassVar[str] = "rubber, foam, soft toys; the default"
    stress: ClassVar[Stress] = STRESS

    def energy_density(self, F: Array) -> Array:
        """Stored energy [J/m^3] of deformation gradients (..., 3, 3), without the stiffness field's factor."""
        return energy_density(F, *self.lame)
