"""Device side of solids differentiated: products of a direction w with the derivatives of the internal forces.

With G = grad w at a particle and phi = G : P its share of -w.f, one cell adds

    out           = d(w.f)/dx            = -sum (dP/dF : G) grad N           elastic: K is symmetric, so also df/dx w
    out_previous  = d(w.f)/dx_previous                                        friction only
    parameter_out = -G : P_m             one column a modulus, and one of the friction

dP/dF : G is the stress of dual numbers. The friction P_v = 2 eta d cof is linear in the rate Fdot and symmetric in (G,
Fdot), phi_v = 2 eta J d : m with d = sym L, m = sym M, L = Fdot F^-1, M = G F^-1. So

    d phi_v / dFdot = 2 eta m cof
    d phi_v / dF    = 2 eta [(d : m) I - L^T m - M^T d] cof

The pieces of text and the legend are those of :mod:`physworld.engine.total.solid_kernels`.
"""

from __future__ import annotations

from functools import cache

import warp as wp

from physworld.engine.lattice.lanes import lanes_float8
from physworld.engine.total.solid_kernels import (
    COFACTOR,
    FLOOR_J,
    LOAD_DISPLACEMENTS,
    LOAD_MODULI,
    gradient,
    scatter,
)
from physworld.materials.stress import Stress

_LOAD_DIRECTIONS = r"""
    float direction[27 * 3], moved[27 * 3];
    for (int a = 0; a < 27; ++a)
        for (int i = 0; i < 3; ++i) {
            const int k = 3 * node[a] + i, m = 3 * node[13] + i;
            direction[3 * a + i] = (float)(w.data[k] - w.data[m]);
            const double step = (x.data[k] - x.data[m]) - (x_previous.data[k] - x_previous.data[m]);
            moved[3 * a + i] = (float)(step * inv_dt);
        }
"""

_PARAMETERS = r"""
        if (wanted) {
            typedef V S;
            const V* all = c;
            const V* H = Hv;
COFACTOR
            for (int m = 0; m < MODULI; ++m) {
                V c[MODULI], P[9];
                for (int k = 0; k < MODULI; ++k) c[k] = k == m ? all[k] : V{};
STRESS
                V work = V{};
                for (int k = 0; k < 9; ++k) work = work + P[k] * G[k];
                for (int k = 0; k < LANES; ++k)
                    parameter_out.data[(cell * 8 + q + k) * (MODULI + 1) + m] -= ((const float*)&work)[k];
            }
        }
"""

_FRICTION = r"""
        if (viscous) {
            typedef V S;
            const V* H = Hv;
COFACTOR
            const V invJ = 1.0f / lane::floor(J, 0.02f);
            const V eta = *(const V*)&eta_volume.data[cell * 8 + q] * 2.0f;
RATE
            V L[9], M[9], d[9], m[9], dm = V{};
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    L[3 * i + j] = (rate[3 * i] * cof[3 * j] + rate[3 * i + 1] * cof[3 * j + 1]
                                    + rate[3 * i + 2] * cof[3 * j + 2]) * invJ;
                    M[3 * i + j] = (G[3 * i] * cof[3 * j] + G[3 * i + 1] * cof[3 * j + 1]
                                    + G[3 * i + 2] * cof[3 * j + 2]) * invJ;
                }
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    d[3 * i + j] = (L[3 * i + j] + L[3 * j + i]) * 0.5f;
                    m[3 * i + j] = (M[3 * i + j] + M[3 * j + i]) * 0.5f;
                }
            for (int k = 0; k < 9; ++k) dm = dm + d[k] * m[k];
            V before[9], bracket[9];
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    V sum = i == j ? dm : V{};
                    for (int k = 0; k < 3; ++k)
                        sum = sum - L[3 * k + i] * m[3 * k + j] - M[3 * k + i] * d[3 * k + j];
                    bracket[3 * i + j] = sum;
                }
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) {
                    V by_rate = V{}, by_shape = V{};
                    for (int k = 0; k < 3; ++k) {
                        by_rate = by_rate + m[3 * i + k] * cof[3 * k + j];
                        by_shape = by_shape + bracket[3 * i + k] * cof[3 * k + j];
                    }
                    before[3 * i + j] = by_rate * eta * inv_dt;
                    T[3 * i + j] = T[3 * i + j] + before[3 * i + j] + by_shape * eta;
                }
            const V work = dm * eta / invJ;
            if (wanted)
                for (int k = 0; k < LANES; ++k)
                    parameter_out.data[(cell * 8 + q + k) * (MODULI + 1) + MODULI] -= ((const float*)&work)[k];
SCATTER_PREVIOUS
        }
"""


def _snippet(stress: Stress, moduli: int) -> str:
    prepare = COFACTOR + (FLOOR_J if stress.infinite_at_inversion else "")
    body = f"            {{\n{stress.body}\n            }}\n"
    return (
        lanes_float8(stress.helpers)
        + f"    const int MODULI = {moduli};\n    const float* number = numbers.data;\n"
        + LOAD_DISPLACEMENTS
        + _LOAD_DIRECTIONS
        + "    for (int q = 0; q < 8; q += LANES) {\n"
        + gradient("u", "Hv")
        + gradient("direction", "G")
        + LOAD_MODULI
        + "        V T[9];\n        {\n            typedef D S;\n            D H[9], P[9];\n"
        + "            for (int k = 0; k < 9; ++k) H[k] = D{Hv[k], G[k]};\n"
        + prepare
        + body
        + "            for (int k = 0; k < 9; ++k) T[k] = P[k].b;\n        }\n"
        + _PARAMETERS.replace("COFACTOR", prepare).replace("STRESS", body)
        + _FRICTION.replace("COFACTOR", COFACTOR)
        .replace("RATE", gradient("moved", "rate"))
        .replace("SCATTER_PREVIOUS", scatter("before", "out_previous", "+"))
        + scatter("T", "out")
        + "    }\n"
    )


@cache
def solid_tangent(stress: Stress, moduli: int) -> wp.Kernel:
    """The kernel of the module's text for one law; ``clock[1]`` is 1/dt [1/s].

    Args:
        stress: text of the law's stress.
        moduli: how many moduli it has.
    """

    @wp.func_native(_snippet(stress, moduli))
    def solid_cell(
        cell: int,
        # model
        cell_nodes: wp.array[wp.int32],
        gradients: wp.array[wp.float32],
        x_rest: wp.array[wp.float64],
        moduli_volume: wp.array[wp.float32],
        eta_volume: wp.array[wp.float32],
        numbers: wp.array[wp.float32],
        inv_dx0: float,
        inv_dx1: float,
        inv_dx2: float,
        viscous: int,
        wanted: int,
        inv_dt: float,
        # in
        x: wp.array[wp.float64],
        x_previous: wp.array[wp.float64],
        w: wp.array[wp.float64],
        # out
        out: wp.array[wp.float64],
        out_previous: wp.array[wp.float64],
        parameter_out: wp.array[wp.float64],
    ) -> None: ...

    @wp.kernel(module=f"physworld_solid_tangent_{stress.name}", enable_backward=False)
    def tangent(
        # model
        cell_nodes: wp.array[wp.int32],
        gradients: wp.array[wp.float32],
        x_rest: wp.array[wp.float64],
        moduli_volume: wp.array[wp.float32],
        eta_volume: wp.array[wp.float32],
        numbers: wp.array[wp.float32],
        inv_dx: wp.vec3f,
        viscous: int,
        wanted: int,
        clock: wp.array[wp.float64],
        # in
        x: wp.array[wp.float64],
        x_previous: wp.array[wp.float64],
        w: wp.array[wp.float64],
        # out
        out: wp.array[wp.float64],
        out_previous: wp.array[wp.float64],
        parameter_out: wp.array[wp.float64],
    ) -> None:
        solid_cell(
            wp.tid(),
            cell_nodes,
            gradients,
            x_rest,
            moduli_volume,
            eta_volume,
            numbers,
            inv_dx[0],
            inv_dx[1],
            inv_dx[2],
            viscous,
            wanted,
            wp.float32(clock[1]),
            x,
            x_previous,
            w,
            out,
            out_previous,
            parameter_out,
        )

    return tangent
