"""Device side of elastic materials in the updated Lagrangian form: F and Kirchhoff stress, 8 particles a thread.

    F <- (I + dt C) F          tau = P(F) F^T + 2 eta J d

P is the text of the body's law (:mod:`physworld.materials.stress`), the same that the total Lagrangian form compiles. F
is kept and advanced in double precision, since the strain of a substep may be smaller than single precision resolves;
F - I is rounded after that. The 8 particles are the lanes of a vector on a CPU and a loop on CUDA.

Legend: F deformation gradient, H = F - I, J = det F, d symmetric part of the velocity gradient C, tau Kirchhoff stress.
"""

from __future__ import annotations

from functools import cache

import warp as wp

from physworld.engine.lattice.lanes import lanes_float8
from physworld.engine.total.solid_kernels import COFACTOR, FLOOR_J, LOAD_MODULI
from physworld.materials.stress import Stress

_ADVANCE = r"""
#if defined(__CUDA_ARCH__)
    typedef double V2;
    #define PW_SET(v, l, value) (v) = (value)
    #define PW_GET(v, l) (v)
    #define PW_SINGLE(v) ((float)(v))
#else
    typedef double V2 __attribute__((vector_size(64)));
    #define PW_SET(v, l, value) (v)[l] = (value)
    #define PW_GET(v, l) (v)[l]
    #define PW_SINGLE(v) __builtin_convertvector(v, V)
#endif
    for (int q = 0; q < 8; q += LANES) {
        const int p = 8 * cell + q;
        V2 f[9], g[9];
        for (int k = 0; k < 9; ++k)
            for (int l = 0; l < LANES; ++l) {
                PW_SET(f[k], l, F_state.data[9 * (p + l) + k]);
                PW_SET(g[k], l, (double)C.data[9 * (p + l) + k]);
            }
        V2 n[9];
        V H[9];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                const int k = 3 * i + j;
                n[k] = f[k] + dt * (g[3 * i] * f[j] + g[3 * i + 1] * f[3 + j] + g[3 * i + 2] * f[6 + j]);
                H[k] = PW_SINGLE(n[k] - (i == j ? 1.0 : 0.0));
            }
        for (int k = 0; k < 9; ++k)
            for (int l = 0; l < LANES; ++l) F_state.data[9 * (p + l) + k] = PW_GET(n[k], l);
"""

_KIRCHHOFF = r"""
        const V e = *(const V*)&eta_volume.data[p] * J;
        const int row[6] = {0, 1, 2, 1, 0, 0}, column[6] = {0, 1, 2, 2, 2, 1};
        for (int k = 0; k < 6; ++k) {
            const int i = row[k], j = column[k];
            const V tau = P[3 * i] * F[3 * j] + P[3 * i + 1] * F[3 * j + 1] + P[3 * i + 2] * F[3 * j + 2]
                + e * PW_SINGLE(g[3 * i + j] + g[3 * j + i]);
            for (int l = 0; l < LANES; ++l) stress.data[6 * (p + l) + k] = PW_GET(tau, l);
        }
        for (int l = 0; l < LANES; ++l) ratio.data[p + l] = PW_GET(J, l);
    }
    #undef PW_SET
    #undef PW_GET
    #undef PW_SINGLE
"""

_REPORT = "        if (lane::any_below(J, 0.02f)) flags.data[3] = 1;\n"


@cache
def elastic_stress(stress: Stress, moduli: int) -> wp.Kernel:
    """The kernel that advances F and writes volume times Kirchhoff stress [J] of 8 particles: xx yy zz yz xz xy.

    Args:
        stress: text of the law's stress.
        moduli: how many moduli it has.
    """
    snippet = (
        lanes_float8(stress.helpers)
        + f"    const int MODULI = {moduli};\n    typedef V S;\n    const float* number = numbers.data;\n"
        + "    const double dt = clock.data[2];\n"
        + _ADVANCE
        + LOAD_MODULI
        + COFACTOR
        + (_REPORT + FLOOR_J if stress.infinite_at_inversion else "")
        + f"        V P[9];\n        {{\n{stress.body}\n        }}\n"
        + _KIRCHHOFF
    )

    @wp.func_native(snippet)
    def particle_group(
        cell: int,
        # model
        moduli_volume: wp.array[wp.float32],
        eta_volume: wp.array[wp.float32],
        numbers: wp.array[wp.float32],
        clock: wp.array[wp.float64],
        # in
        C: wp.array[wp.float32],
        # in, out
        F_state: wp.array[wp.float64],
        # out
        stress: wp.array[wp.float32],
        ratio: wp.array[wp.float32],
        flags: wp.array[wp.int32],
    ) -> None: ...

    @wp.kernel(module=f"physworld_particle_{stress.name}", enable_backward=False)
    def particle_stress(
        # model
        moduli_volume: wp.array[wp.float32],
        eta_volume: wp.array[wp.float32],
        numbers: wp.array[wp.float32],
        clock: wp.array[wp.float64],
        # in
        C: wp.array[wp.float32],
        # in, out
        F_state: wp.array[wp.float64],
        # out
        stress: wp.array[wp.float32],
        ratio: wp.array[wp.float32],
        flags: wp.array[wp.int32],
    ) -> None:
        particle_group(wp.tid(), moduli_volume, eta_volume, numbers, clock, C, F_state, stress, ratio, flags)

    return particle_stress
