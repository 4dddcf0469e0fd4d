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

from physworld.arrays import Array
from physworld.materials.solid import SolidLaw
from physworld.materials.stress import Stress

_HELPERS = r"""
    // a symmetric matrix as its diagonal d and off[s], the entry that stands in neither row nor column s
    static PW_INLINE void rotate(V* d, V* off, V* Q, int p, int r) {   // makes the entry (p, r) zero
        const int s = 3 - p - r;
        const V zeroed = off[s], gap = d[r] - d[p], a = off[r], b = off[p];
        // tangent of the turn: sign(gap) 2 zeroed / (|gap| + sqrt(gap^2 + 4 zeroed^2))
        const V far = absolute(gap) + sqrt(gap * gap + zeroed * zeroed * 4.0f) + 1e-30f;
        const V t = where_positive(gap, zeroed * 2.0f, zeroed * -2.0f) / far;
        const V cosine = 1.0f / sqrt(t * t + 1.0f), sine = t * cosine;
        d[p] = d[p] - t * zeroed;
        d[r] = d[r] + t * zeroed;
        off[s] = V{};
        off[r] = cosine * a - sine * b;
        off[p] = sine * a + cosine * b;
        for (int k = 0; k < 3; ++k) {
            const V u = Q[3 * k + p], w = Q[3 * k + r];
            Q[3 * k + p] = cosine * u - sine * w;
            Q[3 * k + r] = sine * u + cosine * w;
        }
    }
    static PW_INLINE void eigen(V* d, V* off, V* Q) {   // d becomes the eigenvalues; Q has their vectors as columns
        for (int k = 0; k < 9; ++k) Q[k] = V{} + (k % 4 == 0 ? 1.0f : 0.0f);
        for (int sweep = 0; sweep < 4; ++sweep) {
            rotate(d, off, Q, 0, 1);
            rotate(d, off, Q, 0, 2);
            rotate(d, off, Q, 1, 2);
        }
    }
    static PW_INLINE V log_one_plus(V x) {
        const V u = x + 1.0f;
        return log(u) - ((u - 1.0f) - x) / u;
    }
    static PW_INLINE void log_one_plus(const V* E, V* L) {   // ln(I + E) of a symmetric E
        V d[3] = {E[0], E[4], E[8]}, off[3] = {E[5], E[2], E[1]}, Q[9], l[3];
        eigen(d, off, Q);
        for (int k = 0; k < 3; ++k) l[k] = log_one_plus(floor(d[k], -0.999999f));
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                L[3 * i + j] = Q[3 * i] * l[0] * Q[3 * j] + Q[3 * i + 1] * l[1] * Q[3 * j + 1]
                    + Q[3 * i + 2] * l[2] * Q[3 * j + 2];
    }
    static PW_INLINE void log_one_plus(const D* E, D* L) {
        V d[3] = {E[0].a, E[4].a, E[8].a}, off[3] = {E[5].a, E[2].a, E[1].a}, Q[9], l[3], B[9], T[9];
        eigen(d, off, Q);
        for (int k = 0; k < 3; ++k) {
            d[k] = floor(d[k], -0.999999f);
            l[k] = log_one_plus(d[k]);
        }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                T[3 * i + j] = E[3 * i].b * Q[j] + E[3 * i + 1].b * Q[3 + j] + E[3 * i + 2].b * Q[6 + j];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                // (ln A - ln B) / (A - B) = 2 artanh(z) / (z (A + B)), z = (A - B) / (A + B), A = 1 + a: a series
                const V a = d[i], b = d[j], sum = a + b + 2.0f, z = (a - b) / sum, z2 = z * z;
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
    "hencky",
    r"""
    S E[9], L[9];   // C - I = H + H^T + H^T H
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            E[3 * i + j] = H[3 * i + j] + H[3 * j + i]
                + H[i] * H[j] + H[3 + i] * H[3 + j] + H[6 + i] * H[6 + j];
    lane::log_one_plus(E, L);
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
    title: ClassVar[str] = "Hencky solid"
    equation: ClassVar[str] = "W = mu ln U:ln U + lambda/2 (ln J)^2"
    use: ClassVar[str] = (
        "stretches to about 1.3, the elastic part of plasticity; softens beyond a stretch of e"
    )
    stress: ClassVar[Stress] = STRESS

    def energy_density(self, F: Array) -> Array:
        """Stored energy [J/m^3] of deformation gradients (..., 3, 3); infinite where J <= 0."""
        mu, lam = self.lame
        J = np.linalg.det(F)
        stretches = np.linalg.svd(F, compute_uv=False)
        logs = np.log(np.maximum(stretches, np.finfo(float).tiny))
        W = mu * np.sum(logs**2, axis=-1) + 0.5 * lam * np.sum(logs, axis=-1) ** 2
        return np.where(J > 0, W, np.inf)


@dataclass(frozen=True)
class DruckerPragerElastic(Hencky):
    """The elastic law that goes with Drucker-Prager plasticity of sand and soil (Klar et al. 2016, section 4).

    On the logarithmic strain the cone |dev ln U| <= -alpha tr ln U has a return mapping in closed form. Here without
    the yield condition: the total Lagrangian form cannot flow. It has a name of its own, since that is what a choice
    among elastic laws is asked for.
    """

    name: ClassVar[str] = "drucker_prager_elastic"
    title: ClassVar[str] = "Elastic part of Drucker-Prager plasticity"
    use: ClassVar[str] = "sand and soil before they yield"
