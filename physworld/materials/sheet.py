"""Laws of thin sheets, flat at rest: quadratic in the membrane strain and in the change of curvature (Koiter 1966).

    W = K/2 [e11^2 + r e22^2 + 2 nu sqrt(r) e11 e22 + 2 (1 - nu) s e12^2]       membrane
      + D/2 [k11^2 + b k22^2 + 2 nu c sqrt(b) k11 k22 + 2 (1 - nu) t k12^2]     bending
    e_ab = (a_a . a_b - delta_ab) / 2       k_ab = n . x,ab

K = h E / (1 - nu^2) and D are stiffnesses along the first axis (warp); r and b are the ratios of the second (weft) to
them, s, t and c the ratios of shear, twist and of the coupling of the two curvatures to an isotropic sheet's. An
isotropic sheet has all five at 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from physworld.arrays import Array
from physworld.catalogue import Quantity
from physworld.materials.laws import Law


@dataclass(frozen=True)
class SheetLaw(Law):
    """Thin sheet, the same along both axes; isotropic unless the shape of its bending energy says otherwise.

    A homogeneous plate has ``bending_twist_ratio`` 1, a mesh of triangles whose edges bend like hinges about 3.
    ``bending_coupling`` says how much a curvature along one axis calls for the opposite one along the other; the energy
    is positive while abs(c nu) is below 1.
    """

    dimension: ClassVar[int] = 2
    friction_name: ClassVar[str] = "relaxation_s"
    strain_orders: ClassVar[tuple[tuple[int, ...], ...]] = ((1, 0), (0, 1), (2, 0), (0, 2), (1, 1))

    name: ClassVar[str] = "isotropic_sheet"
    title: ClassVar[str] = "Thin isotropic sheet, flat at rest"
    equation: ClassVar[str] = (
        "W = K/2 [e11^2 + e22^2 + 2 nu e11 e22 + 2 (1 - nu) e12^2]"
        " + D/2 [k11^2 + k22^2 + 2 nu c k11 k22 + 2 (1 - nu) t k12^2]"
    )
    use: ClassVar[str] = "paper, film, rubber sheet, felt"

    membrane_n_m: Annotated[float, Quantity("N/m", "K = h E / (1 - nu^2), in-plane stiffness", 0.0)]
    bending_n_m: Annotated[float, Quantity("N m", "D, bending stiffness", 0.0)]
    poissons_ratio: Annotated[float, Quantity("1", "nu, Poisson's ratio", -1.0, 0.5)] = 0.3
    relaxation_s: Annotated[float, Quantity("s", "Kelvin-Voigt time tau of stretch and bending", 0.0)] = 0.0
    density_kg_m2: Annotated[float, Quantity("kg/m^2", "mass per area", 0.0)] = 0.3
    bending_twist_ratio: Annotated[float, Quantity("1", "t, twisting stiffness over a plate's", 0.0)] = 1.0
    bending_coupling: Annotated[float, Quantity("1", "c, coupling of the curvatures over a plate's")] = 1.0

    @property
    def membrane_shape(self) -> tuple[float, float, float, float]:
        """C11, C22, C12 and C33 over K: N11 = C11 e11 + C12 e22, N22 = C12 e11 + C22 e22, N12 = C33 e12."""
        return 1.0, 1.0, self.poissons_ratio, 1.0 - self.poissons_ratio

    @property
    def bending_shape(self) -> tuple[float, float, float, float]:
        """The same of the moments, over D."""
        nu = self.poissons_ratio
        return 1.0, 1.0, nu * self.bending_coupling, (1.0 - nu) * self.bending_twist_ratio

    @property
    def density(self) -> float:
        """Mass per area [kg/m^2]."""
        return self.density_kg_m2

    @property
    def wave_speed_m_s(self) -> float:
        """Speed of the fastest in-plane waves [m/s]."""
        stiffest = max(self.membrane_shape[:2])
        return float(np.sqrt(self.membrane_n_m * stiffest / self.density_kg_m2))

    @property
    def columns(self) -> dict[str, float]:
        """K [N/m], D [N m] and the relaxation time [s]."""
        return {"membrane": self.membrane_n_m, "bending": self.bending_n_m, "relaxation": self.relaxation_s}

    @property
    def stiffness_columns(self) -> tuple[int, ...]:
        """K and D: the friction is in theirs."""
        return 0, 1

    @property
    def shape(self) -> tuple[tuple[float, ...], ...]:
        """The shapes of the membrane's and of the bending energy."""
        return self.membrane_shape, self.bending_shape

    @property
    def friction_law(self) -> Law | None:
        """The friction of stretch and bending."""
        tau = self.relaxation_s
        if tau == 0:
            return None
        return replace(
            self, membrane_n_m=tau * self.membrane_n_m, bending_n_m=tau * self.bending_n_m, relaxation_s=0.0
        )

    def contact_stiffness(self, cell_m: float) -> tuple[float, float]:
        """Of the body's fastest waves over a cell of ``cell_m``, in all directions."""
        rate = self.wave_speed_m_s / cell_m
        return self.density * rate**2, self.density * rate**2

    def energy_of(self, derivatives: Array) -> Array:
        """Stored energy [J/m^2] of derivatives of the surface by :attr:`strain_orders`, (..., 5, 3)."""
        return self.energy_density(*sheet_strains(derivatives))

    def energy_density(self, strain: Array, curvature: Array) -> Array:
        """Stored energy [J/m^2] of strains (e11, e22, e12) and curvatures (k11, k22, k12) [1/m], both (..., 3)."""
        return 0.5 * self.membrane_n_m * _quadratic(self.membrane_shape, strain) + (
            0.5 * self.bending_n_m * _quadratic(self.bending_shape, curvature)
        )


@dataclass(frozen=True)
class OrthotropicSheetLaw(SheetLaw):
    """Woven cloth: warp along the sheet's first axis, weft along its second; see the module's text."""

    name: ClassVar[str] = "orthotropic_sheet"
    title: ClassVar[str] = "Woven sheet, flat at rest"
    equation: ClassVar[str] = (
        "W = K/2 [e11^2 + r e22^2 + 2 nu sqrt(r) e11 e22 + 2 (1 - nu) s e12^2]"
        " + D/2 [k11^2 + b k22^2 + 2 nu c sqrt(b) k11 k22 + 2 (1 - nu) t k12^2]"
    )
    use: ClassVar[str] = (
        "woven cloth: warp and weft along the sheet's axes, shear far softer (s about 0.01 to 0.1)"
    )

    weft_ratio: Annotated[float, Quantity("1", "r, in-plane stiffness, weft over warp", 0.0)] = 1.0
    shear_ratio: Annotated[float, Quantity("1", "s, shear stiffness over an isotropic sheet's", 0.0)] = 1.0
    bending_weft_ratio: Annotated[float, Quantity("1", "b, bending stiffness, weft over warp", 0.0)] = 1.0

    @property
    def membrane_shape(self) -> tuple[float, float, float, float]:
        """C11, C22, C12 and C33 over K."""
        nu, ratio = self.poissons_ratio, self.weft_ratio
        return 1.0, ratio, nu * float(np.sqrt(ratio)), (1.0 - nu) * self.shear_ratio

    @property
    def bending_shape(self) -> tuple[float, float, float, float]:
        """The same of the moments, over D."""
        nu, ratio = self.poissons_ratio, self.bending_weft_ratio
        coupling = nu * float(np.sqrt(ratio)) * self.bending_coupling
        return 1.0, ratio, coupling, (1.0 - nu) * self.bending_twist_ratio


def sheet_strains(derivatives: Array) -> tuple[Array, Array]:
    """Strains (e11, e22, e12) and curvatures (k11, k22, k12) [1/m], both (..., 3).

    Args:
        derivatives: x,1 and x,2 (no unit), x,11, x,22 and x,12 [1/m] of the surface, (..., 5, 3).
    """
    first, second = derivatives[..., 0, :], derivatives[..., 1, :]
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    strain = np.stack(
        [
            0.5 * (np.sum(first * first, axis=-1) - 1),
            0.5 * (np.sum(second * second, axis=-1) - 1),
            0.5 * np.sum(first * second, axis=-1),
        ],
        axis=-1,
    )
    return strain, np.einsum("...i,...ki->...k", normal, derivatives[..., 2:, :])


def _quadratic(shape: tuple[float, float, float, float], s: Array) -> Array:
    c11, c22, c12, c33 = shape
    return (
        c11 * s[..., 0] ** 2
        + c22 * s[..., 1] ** 2
        + 2 * c12 * s[..., 0] * s[..., 1]
        + 2 * c33 * s[..., 2] ** 2
    )
