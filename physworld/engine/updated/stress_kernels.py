"""Device side of stresses beside a law's own on particles: the frame of :mod:`physworld.engine.total.stress_kernels`
for them.

    E = (F^T F - 1) / 2        S from the model's text        volume tau += F S F^T

The model's text is the one that the total Lagrangian form compiles. It reads the whole deformation, so it makes sense
where F is whole: without a flow law. Eight particles are the lanes of a vector; FIELD and STATE are laid out in such
groups.

Legend: F deformation gradient, E Green strain, S second Piola-Kirchhoff stress times volume, tau Kirchhoff stress.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import warp as wp

from physworld.engine.lattice.lanes import lanes_float8
from physworld.engine.total.stress_kernels import ROWS, SOLID_CORE

_LOAD = r"""
#if defined(__CUDA_ARCH__)
    #define PW_LANE(v, l) (v)
#else
    #define PW_LANE(v, l) (v)[l]
#endif
    const float scale[3] = {1.0f, 1.0f, 1.0f};
    for (int q = 0; q < 8; q += LANES) {
        const int p = 8 * cell + q;
        V F[9];
        for (int k = 0; k < 9; ++k)
            for (int l = 0; l < LANES; ++l)
                PW_LANE(F[k], l) = (float)(F_state.data[9 * (p + l) + k] - (k % 4 ? 0.0 : 1.0));
"""

_ADD = r"""
        const int at_row[6] = {0, 1, 2, 1, 0, 0}, at_column[6] = {0, 1, 2, 2, 2, 1};
        for (int k = 0; k < 6; ++k) {
            const int i = 3 * at_row[k], j = 3 * at_column[k];
            const V tau = P[i] * F[j] + P[i + 1] * F[j + 1] + P[i + 2] * F[j + 2];
            for (int l = 0; l < LANES; ++l) stress.data[6 * (p + l) + k] += PW_LANE(tau, l);
        }
    }
    #undef PW_LANE
    #undef FIELD
    #undef STATE
    #undef PARAMETER
    #undef ROOT
    #undef POSITIVE
"""


@wp.kernel(enable_backward=False)
def grow_stress(
    # model
    times: wp.array[wp.float64],
    rate: wp.float64,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in, out
    stress: wp.array[wp.float32],
) -> None:
    """Multiply one component of the stresses [J] by exp(rate t)."""
    k = wp.tid()
    time = times[counter[0]] + wp.float64(counter[1]) * clock[2]
    stress[k] = stress[k] * wp.float32(wp.exp(rate * time))


@cache
def particle_model(model: str) -> Any:
    """The kernel that adds a solid model's stress to 8 particles: ``model`` is the text that sets S from E."""

    @wp.func_native(
        lanes_float8() + ROWS.replace("WIDTH", "8") + _LOAD + SOLID_CORE.replace("MODEL", model) + _ADD
    )
    def group_stress(
        cell: int,
        # model
        cells: int,
        rows: int,
        parameters: wp.array[wp.float32],
        fields: wp.array[wp.float32],
        first: int,
        dt: float,
        # in
        F_state: wp.array[wp.float64],
        # in, out
        state: wp.array[wp.float32],
        stress: wp.array[wp.float32],
    ) -> None: ...

    @wp.kernel(module="unique", enable_backward=False)
    def add_stress(
        # model
        cells: int,
        rows: int,
        parameters: wp.array[wp.float32],
        fields: wp.array[wp.float32],
        clock: wp.array[wp.float64],
        counter: wp.array[wp.int32],
        # in
        F_state: wp.array[wp.float64],
        # in, out
        state: wp.array[wp.float32],
        stress: wp.array[wp.float32],
    ) -> None:
        first = wp.where(counter[0] + counter[1] == 0, 1, 0)
        group_stress(
            wp.tid(), cells, rows, parameters, fields, first, wp.float32(clock[2]), F_state, state, stress
        )

    return add_stress
