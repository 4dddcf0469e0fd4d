"""Device side of plastic materials: Hencky strain, return mapping, Kirchhoff stress, one particle a thread.

    F <- (I + dt C) F                                                 trial
    B = F F^T = sum sigma_i^2 n_i n_i^T      eps_i = ln sigma_i             principal Hencky (logarithmic) strains
    eps <- return mapping (:mod:`physworld.materials.plastic`)
    tau = sum (2 mu eps_i + lambda tr eps) n_i n_i^T                         St. Venant-Kirchhoff in Hencky strain
    F  <- [sum exp(eps_i - ln sigma_i) n_i n_i^T] F                          the elastic part of F

The left singular vectors of F are the eigenvectors of B, and the right ones are not needed, so no singular value
decomposition is taken: Jacobi rotations of B in double precision (Golub and Van Loan, section 8.5) are exact to
rounding, and 8 particles rotate at once as the lanes of a vector. F is turned back only where the return mapping
changed the strain: an elastic particle does not drift.

Legend: F deformation gradient (elastic part), B left Cauchy-Green tensor, n its eigenvectors.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

eigen_type = wp.types.matrix(shape=(4, 3), dtype=wp.float64)

_STRETCH = r"""
#if defined(__CUDA_ARCH__)
    typedef double V;
    const int LANES = 1;
    #define PW_LANE(v, l) (v)
    #define PW_ROOT(v) sqrt(v)
    #define PW_SIGNED(test, v) ((test) < 0.0 ? -(v) : (v))
    #define PW_SIZE(v) fabs(v)
#else
    typedef double V __attribute__((vector_size(64)));
    typedef long long I __attribute__((vector_size(64)));
    const int LANES = 8;
    const I sign = I{} + (long long)(1ull << 63);
    #define PW_LANE(v, l) (v)[l]
    #define PW_ROOT(v) __builtin_elementwise_sqrt(v)
    #define PW_SIGNED(test, v) (V)((I)(v) ^ (((test) < 0.0) & sign))
    #define PW_SIZE(v) (V)((I)(v) & ~sign)
#endif
    const double dt = clock.data[2];
    double* found = (double*)eigen.data;
    for (int lane = 0; lane < 8; lane += LANES) {
        const int p = 8 * group + lane;
        V f[9], g[9], F[9];
        for (int k = 0; k < 9; ++k)
            for (int l = 0; l < LANES; ++l) {
                PW_LANE(f[k], l) = F_state.data[9 * (p + l) + k];
                PW_LANE(g[k], l) = (double)C.data[9 * (p + l) + k];
            }
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                F[3 * i + j] = f[3 * i + j]
                    + dt * (g[3 * i] * f[j] + g[3 * i + 1] * f[3 + j] + g[3 * i + 2] * f[6 + j]);
        V A[3][3], Q[3][3];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                A[i][j] = F[3 * i] * F[3 * j] + F[3 * i + 1] * F[3 * j + 1] + F[3 * i + 2] * F[3 * j + 2];
                Q[i][j] = V{} + (i == j ? 1.0 : 0.0);
            }
        const int first[3] = {0, 0, 1}, second[3] = {1, 2, 2};
        for (int sweep = 0; sweep < 12; ++sweep) {
            const V off = A[0][1] * A[0][1] + A[0][2] * A[0][2] + A[1][2] * A[1][2];
            const V trace = A[0][0] + A[1][1] + A[2][2];
            const V left = off - 1.0e-22 * trace * trace;
            bool done = true;
            for (int l = 0; l < LANES; ++l) done = done && !(PW_LANE(left, l) > 0.0);
            if (done) break;
            for (int k = 0; k < 3; ++k) {
                const int a = first[k], b = second[k], r = 3 - a - b;
                const V ab = A[a][b], ar = A[a][r], br = A[b][r], gap = A[b][b] - A[a][a];
                const V t = PW_SIGNED(gap, 2.0 * ab) / (PW_SIZE(gap) + PW_ROOT(gap * gap + 4.0 * ab * ab) + 1.0e-300);
                const V c = 1.0 / PW_ROOT(t * t + 1.0), s = t * c;
                A[a][a] -= t * ab;
                A[b][b] += t * ab;
                A[a][b] = A[b][a] = V{};
                A[a][r] = A[r][a] = c * ar - s * br;
                A[b][r] = A[r][b] = s * ar + c * br;
                for (int i = 0; i < 3; ++i) {
                    const V qa = Q[i][a], qb = Q[i][b];
                    Q[i][a] = c * qa - s * qb;
                    Q[i][b] = s * qa + c * qb;
                }
            }
        }
        for (int l = 0; l < LANES; ++l)
            for (int i = 0; i < 3; ++i) {
                found[12 * (p + l) + 9 + i] = PW_LANE(A[i][i], l);
                for (int j = 0; j < 3; ++j) {
                    found[12 * (p + l) + 3 * i + j] = PW_LANE(Q[j][i], l);
                    F_state.data[9 * (p + l) + 3 * i + j] = PW_LANE(F[3 * i + j], l);
                }
            }
    }
    #undef PW_LANE
    #undef PW_ROOT
    #undef PW_SIGNED
    #undef PW_SIZE
"""


@wp.func_native(_STRETCH)
def _stretch(
    group: int,
    clock: wp.array[wp.float64],
    C: wp.array[wp.float32],
    F_state: wp.array[wp.float64],
    eigen: wp.array[eigen_type],
) -> None: ...


@wp.kernel(enable_backward=False)
def stretch(
    clock: wp.array[wp.float64],
    # in
    C: wp.array[wp.float32],
    # in, out
    F_state: wp.array[wp.float64],
    # out
    eigen: wp.array[eigen_type],
) -> None:
    """Trial F of 8 particles, and of its B eigenvectors (rows 0 to 2) and eigenvalues (row 3).

    Jacobi's tan in a form without a pole, so that all lanes rotate alike.
    """
    _stretch(wp.tid(), clock, C, F_state, eigen)


@wp.func
def outer_sum(eigen: Any, values: wp.vec3d) -> wp.mat33d:
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
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        volume: wp.array[wp.float32],
        eta: wp.array[wp.float32],
        parameters: wp.vec3d,
        clock: wp.array[wp.float64],
        C: wp.array[wp.float32],
        eigen: wp.array[eigen_type],
        # in, out
        F: wp.array[wp.mat33d],
        state: wp.array[wp.float64],
        # out
        stress: wp.array[wp.float32],
        ratio: wp.array[wp.float32],
        flags: wp.array[wp.int32],
    ) -> None:
        p = wp.tid()
        c = 9 * p
        found = eigen[p]
        least = wp.min(found[3, 0], wp.min(found[3, 1], found[3, 2]))
        if not (least > wp.float64(1.0e-8)):
            flags[3] = 1
            return
        half = wp.float64(0.5)
        eps = half * wp.vec3d(wp.log(found[3, 0]), wp.log(found[3, 1]), wp.log(found[3, 2]))
        m = wp.float64(mu[p])
        l = wp.float64(lam[p])
        mapped = project(eps, m, l, parameters, state[p], clock[2])
        new = wp.vec3d(mapped[0], mapped[1], mapped[2])
        state[p] = mapped[3]
        if new[0] != eps[0] or new[1] != eps[1] or new[2] != eps[2]:
            change = wp.vec3d(wp.exp(new[0] - eps[0]), wp.exp(new[1] - eps[1]), wp.exp(new[2] - eps[2]))
            F[p] = outer_sum(found, change) * F[p]
        trace = new[0] + new[1] + new[2]
        ratio[p] = wp.float32(wp.exp(trace))
        pressure = l * trace
        two = wp.float64(2.0)
        principal = wp.vec3d(
            two * m * new[0] + pressure, two * m * new[1] + pressure, two * m * new[2] + pressure
        )
        tau = wp.float64(volume[p]) * outer_sum(found, principal)
        friction = eta[p]
        at = 6 * p
        stress[at] = wp.float32(tau[0, 0]) + 2.0 * friction * C[c]
        stress[at + 1] = wp.float32(tau[1, 1]) + 2.0 * friction * C[c + 4]
        stress[at + 2] = wp.float32(tau[2, 2]) + 2.0 * friction * C[c + 8]
        stress[at + 3] = wp.float32(tau[1, 2]) + friction * (C[c + 5] + C[c + 7])
        stress[at + 4] = wp.float32(tau[0, 2]) + friction * (C[c + 2] + C[c + 6])
        stress[at + 5] = wp.float32(tau[0, 1]) + friction * (C[c + 1] + C[c + 3])

    return plastic_stress
