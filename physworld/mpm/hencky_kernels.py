"""Device side of plastic materials: Hencky strain, return mapping, Kirchhoff stress, one particle a thread.

    F <- (I + dt C) F                                                 trial
    B = F F^T = sum sigma_i^2 n_i n_i^T      eps_i = ln sigma_i             principal Hencky (logarithmic) strains
    eps <- return mapping (:mod:`physworld.materials.plastic`)
    tau = sum (2 mu eps_i + lambda tr eps) n_i n_i^T                         St. Venant-Kirchhoff in Hencky strain
    F  <- [sum exp(eps_i - ln sigma_i) n_i n_i^T] F                          the elastic part of F

The left singular vectors of F are the eigenvectors of B, and the right ones are not needed, so no singular value
decomposition is taken: Jacobi rotations of B in double precision (Golub and Van Loan, section 8.5) cost a quarter of
Warp's ``svd3`` and are exact to rounding. F is turned back only where the return mapping changed the
strain: an elastic particle does not drift.

Legend: F deformation gradient (elastic part), B left Cauchy-Green tensor, n its eigenvectors.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

eigen_type = wp.types.matrix(shape=(4, 3), dtype=wp.float64)

_JACOBI = r"""
    double A[3][3], Q[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) A[i][j] = B.data[i][j];
    const int first[3] = {0, 0, 1}, second[3] = {1, 2, 2};
    for (int sweep = 0; sweep < 12; ++sweep) {
        const double off = A[0][1] * A[0][1] + A[0][2] * A[0][2] + A[1][2] * A[1][2];
        const double trace = A[0][0] + A[1][1] + A[2][2];
        if (off <= 1.0e-22 * trace * trace) break;
        for (int k = 0; k < 3; ++k) {
            const int p = first[k], q = second[k], r = 3 - p - q;
            if (A[p][q] == 0.0) continue;
            const double theta = 0.5 * (A[q][q] - A[p][p]) / A[p][q];
            const double t = (theta >= 0.0 ? 1.0 : -1.0) / (fabs(theta) + sqrt(theta * theta + 1.0));
            const double c = 1.0 / sqrt(t * t + 1.0), s = t * c;
            const double pq = A[p][q], pr = A[p][r], qr = A[q][r];
            A[p][p] -= t * pq;
            A[q][q] += t * pq;
            A[p][q] = A[q][p] = 0.0;
            A[p][r] = A[r][p] = c * pr - s * qr;
            A[q][r] = A[r][q] = s * pr + c * qr;
            for (int i = 0; i < 3; ++i) {
                const double a = Q[i][p], b = Q[i][q];
                Q[i][p] = c * a - s * b;
                Q[i][q] = s * a + c * b;
            }
        }
    }
    wp::mat_t<4, 3, double> out;
    for (int i = 0; i < 3; ++i) {
        out.data[3][i] = A[i][i];
        for (int j = 0; j < 3; ++j) out.data[i][j] = Q[j][i];
    }
    return out;
"""


@wp.func_native(_JACOBI)
def symmetric_eigen(B: wp.mat33d) -> eigen_type:
    """Eigenvectors (rows 0 to 2) and eigenvalues (row 3) of a symmetric matrix."""


@wp.func
def outer_sum(eigen: eigen_type, values: wp.vec3d) -> wp.mat33d:
    """The symmetric matrix with the eigenvectors of ``eigen`` and other eigenvalues."""
    total = wp.mat33d()
    for k in range(3):
        n = wp.vec3d(eigen[k, 0], eigen[k, 1], eigen[k, 2])
        total += values[k] * wp.outer(n, n)
    return total


@cache
def plastic_kernel(project: Any) -> Any:
    """The kernel of one return mapping.

    ``project(eps, mu, lam, parameters, state, dt) -> (eps, state)`` as a vec4d: principal Hencky strains before and
    after, elastic constants [Pa], the law's own parameters and its scalar memory, the time step [s].
    """

    @wp.kernel(module="unique", enable_backward=False)
    def plastic_stress(
        # model
        mu: wp.array(dtype=wp.float32),
        lam: wp.array(dtype=wp.float32),
        volume: wp.array(dtype=wp.float32),
        eta: wp.array(dtype=wp.float32),
        parameters: wp.vec3d,
        clock: wp.array(dtype=wp.float64),
        C: wp.array(dtype=wp.float32),
        # in, out
        F: wp.array(dtype=wp.mat33d),
        state: wp.array(dtype=wp.float64),
        # out
        stress: wp.array(dtype=wp.float32),
        ratio: wp.array(dtype=wp.float32),
        flags: wp.array(dtype=wp.int32),
    ):
        p = wp.tid()
        c = 9 * p
        gradient = wp.mat33d(
            wp.float64(C[c]), wp.float64(C[c + 1]), wp.float64(C[c + 2]),
            wp.float64(C[c + 3]), wp.float64(C[c + 4]), wp.float64(C[c + 5]),
            wp.float64(C[c + 6]), wp.float64(C[c + 7]), wp.float64(C[c + 8]),
        )  # fmt: skip
        trial = F[p] + clock[2] * (gradient * F[p])
        eigen = symmetric_eigen(trial * wp.transpose(trial))
        least = wp.min(eigen[3, 0], wp.min(eigen[3, 1], eigen[3, 2]))
        if not (least > wp.float64(1.0e-8)):
            flags[3] = 1
            return
        half = wp.float64(0.5)
        eps = half * wp.vec3d(wp.log(eigen[3, 0]), wp.log(eigen[3, 1]), wp.log(eigen[3, 2]))
        m = wp.float64(mu[p])
        l = wp.float64(lam[p])
        mapped = project(eps, m, l, parameters, state[p], clock[2])
        new = wp.vec3d(mapped[0], mapped[1], mapped[2])
        state[p] = mapped[3]
        if new[0] != eps[0] or new[1] != eps[1] or new[2] != eps[2]:
            change = wp.vec3d(wp.exp(new[0] - eps[0]), wp.exp(new[1] - eps[1]), wp.exp(new[2] - eps[2]))
            F[p] = outer_sum(eigen, change) * trial
        else:
            F[p] = trial
        trace = new[0] + new[1] + new[2]
        ratio[p] = wp.float32(wp.exp(trace))
        pressure = l * trace
        two = wp.float64(2.0)
        principal = wp.vec3d(
            two * m * new[0] + pressure, two * m * new[1] + pressure, two * m * new[2] + pressure
        )
        tau = wp.float64(volume[p]) * outer_sum(eigen, principal)
        friction = eta[p]
        at = 6 * p
        stress[at] = wp.float32(tau[0, 0]) + 2.0 * friction * C[c]
        stress[at + 1] = wp.float32(tau[1, 1]) + 2.0 * friction * C[c + 4]
        stress[at + 2] = wp.float32(tau[2, 2]) + 2.0 * friction * C[c + 8]
        stress[at + 3] = wp.float32(tau[1, 2]) + friction * (C[c + 5] + C[c + 7])
        stress[at + 4] = wp.float32(tau[0, 2]) + friction * (C[c + 2] + C[c + 6])
        stress[at + 5] = wp.float32(tau[0, 1]) + friction * (C[c + 1] + C[c + 3])

    return plastic_stress
