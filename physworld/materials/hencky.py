"""Hencky solid: quadratic in the logarithmic strain (Hencky 1928; Xiao and Chen 2002).

    W = mu ln U : ln U + lambda/2 (ln J)^2       P = F C^-1 (mu ln C + lambda ln(J) I)       C = F^T F = U^2

Good to stretches of about 1.3, and the elastic part of most finite-strain plasticity, where a return mapping is as
simple on ln U as it is at small strain. ln C takes the one eigen-decomposition of this library: cyclic Jacobi, four
sweeps. Its derivative is that of Daleckii and Krein, with divided differences of the logarithm, so that equal
stretches are no special case.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from physworld.materials.solid import SolidLaw
from physworld.materials.stress import Stress

_HELPERS = r"""
    static CUDA_CALLABLE void eigen(V* A, V* Q) {   // A (3 x 3, symmetric) becomes diagonal; Q holds the vectors
        for (int k = 0; k < 9; ++k) Q[k] = V{} + (k % 4 == 0 ? 1.0f : 0.0f);
        for (int turn = 0; turn < 12; ++turn) {
            const int p = turn % 3 == 2 ? 1 : 0, r = turn % 3 == 0 ? 1 : 2;
            const V off = A[3 * p + r], gap = A[4 * r] - A[4 * p];
            // t = tan of the turn: sign(gap) 2 off / (|gap| + sqrt(gap^2 + 4 off^2))
            const V far = absolute(gap) + sqrt(gap * gap + off * off * 4.0f) + 1e-30f;
            const V t = where_positive(gap, off * 2.0f, off * -2.0f) / far;
            const V cosine = 1.0f / sqrt(t * t + 1.0f), sine = t * cosine;
            for (int k = 0; k < 3; ++k) {
                const V a = A[3 * k + p], b = A[3 * k + r];
                A[3 * k + p] = cosine * a - sine * b;
                A[3 * k + r] = sine * a + cosine * b;
            }
            for (int k = 0; k < 3; ++k) {
                const V a = A[3 * p + k], b = A[3 * r + k];
                A[3 * p + k] = cosine * a - sine * b;
                A[3 * r + k] = sine * a + cosine * b;
                const V u = Q[3 * k + p], w = Q[3 * k + r];
                Q[3 * k + p] = cosine * u - sine * w;
                Q[3 * k + r] = sine * u + cosine * w;
            }
        }
    }
    static CUDA_CALLABLE void log_symmetric(const V* C, V* L) {
        V A[9], Q[9], l[3];
        for (int k = 0; k < 9; ++k) A[k] = C[k];
        eigen(A, Q);
        for (int k = 0; k < 3; ++k) l[k] = log(floor(A[4 * k], 1e-6f));
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                L[3 * i + j] = Q[3 * i] * l[0] * Q[3 * j] + Q[3 * i + 1] * l[1] * Q[3 * j + 1]
                    + Q[3 * i + 2] * l[2] * Q[3 * j + 2];
    }
    static CUDA_CALLABLE void log_symmetric(const D* C, D* L) {
        V A[9], Q[9], l[3], B[9], T[9];
        for (int k = 0; k < 9; ++k) A[k] = C[k].a;
        eigen(A, Q);
        for (int k = 0; k < 3; ++k) {
            A[4 * k] = floor(A[4 * k], 1e-6f);
            l[k] = log(A[4 * k]);
        }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                T[3 * i + j] = C[3 * i].b * Q[j] + C[3 * i + 1].b * Q[3 + j] + C[3 * i + 2].b * Q[6 + j];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                // (ln a - ln b) / (a - b) = 2 artanh(z) / (z (a + b)), z = (a - b) / (a + b): a series for small z
                const V a = A[4 * i], b = A[4 * j], sum = a + b, z = (a - b) / sum, z2 = z * z;
                const V series = (((z2 * 0.14285714f + 0.2f) * z2 + 0.33333333f) * z2 + 1.0f) * 2.0f / sum;
                const V safe = where_positive(z2 - 0.01f, a - b, V{} + 1.0f);
                const V slope = where_positive(z2 - 0.01f, (l[i] - l[j]) / safe, series);
                B[3 * i + j] = (Q[i] * T[j] + Q[3 + i] * T[3 + j] + Q[6 + i] * T[6 + j]) * slope;
            }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                T[3 * i + j] = Q[3 * i] * B[j] + Q[3 * i + 1] * B[3 + j] + Q[3 * i + 2] * B[6 + j];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                L[3 * i + j].a = Q[3 * i] * l[0] * Q[3 * j] + Q[3 * i + 1] * l[1] * Q[3 * j + 1]
                    + Q[3 * i + 2] * l[2] * Q[3 * j + 2];
                L[3 * i + j].b = T[3 * i] * Q[3 * j] + T[3 * i + 1] * Q[3 * j + 1] + T[3 * i + 2] * Q[3 * j + 2];
            }
    }
"""

STRESS = Stress(
    r"""
    S C[9], L[9];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) C[3 * i + j] = F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j];
    lane::log_symmetric(C, L);
    const S pressure = (L[0] + L[4] + L[8]) * (c[1] * 0.5f);
    for (int k = 0; k < 9; ++k) L[k] = L[k] * c[0];
    for (int i = 0; i < 3; ++i) L[4 * i] = L[4 * i] + pressure;
    const S inverse = lane::inverse(J);   // F C^-1 = F^-T
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            P[3 * i + j] = (cof[3 * i] * L[j] + cof[3 * i + 1] * L[3 + j] + cof[3 * i + 2] * L[6 + j]) * inverse;
    """,
    helpers=_HELPERS,
    infinite_at_inversion=True,
)


@dataclass(frozen=True)
class Hencky(SolidLaw):
    """Hencky solid: see the module's text."""

    name: ClassVar[str] = "hencky"
    stress: ClassVar[Stress] = STRESS

    def energy_density(self, F: np.ndarray) -> np.ndarray:
        """Stored energy [J/m^3] of deformation gradients (..., 3, 3); infinite where J <= 0."""
        mu, lam = self.lame
        J = np.linalg.det(F)
        stretches = np.linalg.svd(F, compute_uv=False)
        logs = np.log(np.maximum(stretches, np.finfo(float).tiny))
        W = mu * np.sum(logs**2, axis=-1) + 0.5 * lam * np.sum(logs, axis=-1) ** 2
        return np.where(J > 0, W, np.inf)
