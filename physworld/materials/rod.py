"""The law of ropes and rods, straight at rest.

    W = EA/2 (|x'| - 1)^2 + B/2 |k|^2       k = x' x x'' / |x'|^3       B = EI

The rod is isotropic about its axis. Twist is not carried: it would need an angle at every node beside the position, and
it decouples from an isotropic rod whose ends are not twisted (Bergou et al. 2008).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np


@dataclass(frozen=True)
class RodLaw:
    """Rope or rod, straight at rest.

    Attributes:
        stretching_n: EA, force per strain [N].
        bending_n_m2: B = EI, bending stiffness [N m^2].
        relaxation_s: Kelvin-Voigt time tau of bending.
        density_kg_m: mass per length.
    """

    name: ClassVar[str] = "rod"

    stretching_n: float
    bending_n_m2: float
    relaxation_s: float = 0.0
    density_kg_m: float = 0.05

    @property
    def wave_speed_m_s(self) -> float:
        """Speed of stretch waves [m/s]."""
        return float(np.sqrt(self.stretching_n / self.density_kg_m))

    def energy_density(self, strain: np.ndarray, curvature: np.ndarray) -> np.ndarray:
        """Stored energy [J/m] of strains |x'| - 1, (...), and curvature vectors [1/m], (..., 3)."""
        return 0.5 * self.stretching_n * strain**2 + 0.5 * self.bending_n_m2 * np.sum(curvature**2, axis=-1)


def rod_strains(derivatives: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Strain |x'| - 1, (...), and curvature vector x' x x'' / |x'|^3 [1/m], (..., 3).

    Args:
        derivatives: x' (no unit) and x'' [1/m] of the centre line, (..., 2, 3).
    """
    tangent, bend = derivatives[..., 0, :], derivatives[..., 1, :]
    length = np.linalg.norm(tangent, axis=-1)
    return length - 1, np.cross(tangent, bend) / length[..., None] ** 3
