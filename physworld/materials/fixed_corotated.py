"""Fixed corotated solid (Stomakhin, Howes, Schroeder, Teran 2012).

    W = mu |F - R|^2 + lambda/2 (J - 1)^2
    P = 2 mu (F - R) + lambda (J - 1) J F^-T                  F = R U, R the nearest rotation

Quadratic in the stretches and finite at J = 0: a body may turn inside out and come back, which is not reported. R comes
without a singular value decomposition: s = tr U is the largest root of

    (s^2 - |F|^2)^2 - 4 |cof F|^2 - 8 J s = 0                 (all four roots are real: Newton from above converges)

and R = ds/dF by implicit differentiation (Lin, Chitalu, Komura 2022). An inverted F gives its nearest rotation too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from physworld.arrays import Array
from physworld.materials.solid import SolidLaw
from physworld.materials.stress import Stress

STRESS = Stress(
    "fixed_corotated",
    r"""
    S square = F[0] * F[0], cofactors = cof[0] * cof[0];
    for (int k = 1; k < 9; ++k) {
        square = square + F[k] * F[k];
        cofactors = cofactors + cof[k] * cof[k];
    }
    const V I = lane::value(square), II = lane::value(cofactors), III = lane::value(J);
    V root = lane::sqrt(I * 3.0f), slope = root;
    for (int iteration = 0; iteration < 7; ++iteration) {
        const V gap = root * root - I;
        slope = lane::floor((root * gap - III * 2.0f) * 4.0f, 1e-3f);
        root = root - (gap * gap - II * 4.0f - III * root * 8.0f) / slope;
    }
    const V gap = root * root - I;   // one more step, in S: it carries the root's derivative
    slope = lane::floor((root * gap - III * 2.0f) * 4.0f, 1e-3f);
    const S missed = square * -1.0f + root * root;
    const S s = (missed * missed - cofactors * 4.0f - J * (root * 8.0f)) * (-1.0f / slope) + root;
    const S spread = s * s - square;
    const S turn = lane::inverse(lane::floor(s * spread - J * 2.0f, 2.5e-4f)) * (c[0] * -2.0f);
    const S straight = (spread + square * 2.0f) * turn + c[0] * 2.0f;
    const S twice = turn * -2.0f;
    const S rest = s * turn * 2.0f + (J - 1.0f) * c[1];
    S C[9];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) C[3 * i + j] = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            P[3 * i + j] = straight * F[3 * i + j] + rest * cof[3 * i + j]
                + twice * (F[3 * i] * C[j] + F[3 * i + 1] * C[3 + j] + F[3 * i + 2] * C[6 + j]);
    """,
)


@dataclass(frozen=True)
class FixedCorotated(SolidLaw):
    """Fixed corotated solid: see the module's text."""

    name: ClassVar[str] = "fixed_corotated"
    title: ClassVar[str] = "Fixed corotated solid"
    equation: ClassVar[str] = "W = mu |F - R|^2 + lambda/2 (J - 1)^2"
    use: ClassVar[str] = "bodies that are squeezed flat or inside out and come back, which is not reported"
    stress: ClassVar[Stress] = STRESS

    def energy_density(self, F: Array) -> Array:
        """Stored energy [J/m^3] of deformation gradients (..., 3, 3)."""
        mu, lam = self.lame
        J = np.linalg.det(F)
        stretches = np.linalg.svd(F, compute_uv=False)
        stretches[..., 2] *= np.where(J < 0, -1.0, 1.0)
        energy: Array = mu * np.sum((stretches - 1) ** 2, axis=-1) + 0.5 * lam * (J - 1) ** 2
        return energy
