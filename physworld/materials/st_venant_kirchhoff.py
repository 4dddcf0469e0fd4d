"""St. Venant-Kirchhoff solid on the Green strain (Bonet and Wood 2008, section 6.4.1).

    E = (F^T F - I) / 2       W = mu E:E + lambda/2 (tr E)^2       P = F (2 mu E + lambda tr(E) I)

Linear elasticity made indifferent to rotation: right for thin or stiff bodies that turn far and strain little. Under
compression it softens and gives way below a stretch of 1/sqrt(3), so it is not for soft bodies that are squeezed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from physworld.arrays import Array
from physworld.materials.solid import SolidLaw
from physworld.materials.stress import Stress

STRESS = Stress(
    "st_venant_kirchhoff",
    r"""
    S T[9];   // twice the Green strain, H + H^T + H^T H; then the second Piola-Kirchhoff stress
    for (int i = 0; i < 3; ++i)
        for (int j = i; j < 3; ++j)
            T[3 * i + j] = H[3 * i + j] + H[3 * j + i]
                + H[i] * H[j] + H[3 + i] * H[3 + j] + H[6 + i] * H[6 + j];
    const S trace = (T[0] + T[4] + T[8]) * (c[1] * 0.5f);
    for (int i = 0; i < 3; ++i)
        for (int j = i; j < 3; ++j) {
            T[3 * i + j] = T[3 * i + j] * c[0];
            if (i == j) T[3 * i + j] = T[3 * i + j] + trace;
            T[3 * j + i] = T[3 * i + j];
        }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            P[3 * i + j] = F[3 * i] * T[j] + F[3 * i + 1] * T[3 + j] + F[3 * i + 2] * T[6 + j];
    """,
)


@dataclass(frozen=True)
class StVenantKirchhoff(SolidLaw):
    """St. Venant-Kirchhoff solid on the Green strain: see the module's text."""

    name: ClassVar[str] = "st_venant_kirchhoff"
    title: ClassVar[str] = "St. Venant-Kirchhoff solid"
    equation: ClassVar[str] = "W = mu E:E + lambda/2 (tr E)^2, E = (C - I)/2"
    use: ClassVar[str] = (
        "stiff or thin bodies: large turns, small strains; gives way below a stretch of 1/sqrt(3)"
    )
    stress: ClassVar[Stress] = STRESS

    def energy_density(self, F: Array) -> Array:
        """Stored energy [J/m^3] of deformation gradients (..., 3, 3)."""
        mu, lam = self.lame
        E = 0.5 * (np.swapaxes(F, -1, -2) @ F - np.eye(3))
        energy: Array = mu * np.sum(E**2, axis=(-2, -1)) + 0.5 * lam * np.trace(E, axis1=-2, axis2=-1) ** 2
        return energy
