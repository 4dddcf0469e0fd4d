"""Device side of elastic solids: internal forces of a body under one law, one cell a thread.

    P = P(F) + 2 eta d J F^-T                    (first Piola-Kirchhoff; the law's stress, Kelvin-Voigt viscosity)
    f_a -= sum_q V_q P(F_q) grad N_a(q)

The 8 particles of a cell are the 8 lanes of a vector; the B-spline gradients at them are the same 27 x 3 x 8 numbers
in every cell. On a CPU the lanes are one SIMD register, on CUDA they are a loop. Displacements are taken relative to
the cell's middle node before they are rounded to single precision (the gradients of a constant vanish), so a strain
keeps 7 digits wherever the body is.

The kernel is a template over the text of a law's stress (:mod:`physworld.materials.stress`): :func:`solid_forces`
builds it once a law, in a Warp module of its own, so that a process compiles only the laws it uses. The pieces of the
text are shared with the tangent (:mod:`physworld.engine.gradients.solid_tangent_kernels`).

Legend: F deformation gradient, H = F - I, J its determinant, cof = J F^-T, c moduli times volume, scale 1/dx.
"""

from __future__ import annotations

from functools import cache

import warp as wp

from physworld.engine.lattice.lanes import lanes_float8
from physworld.materials.stress import Stress

LOAD_DISPLACEMENTS = r"""
    const int* node = &cell_nodes.data[cell * 27];
    const double* anchor = &x.data[3 * node[13]];
    const double* anchor_rest = &x_rest.data[3 * node[13]];
    float u[27 * 3];
    for (int a = 0; a < 27; ++a) {
        for (int i = 0; i < 3; ++i) {
            const int k = 3 * node[a] + i;
            u[3 * a + i] = (float)((x.data[k] - anchor[i]) - (x_rest.data[k] - anchor_rest[i]));
        }
    }
    const float scale[3] = {inv_dx0, inv_dx1, inv_dx2};
"""

_GRADIENT = r"""
        V INTO[9];
        for (int k = 0; k < 9; ++k) INTO[k] = V{};
        for (int a = 0; a < 27; ++a) {
            const V g0 = *(const V*)&gradients.data[(3 * a + 0) * 8 + q];
            const V g1 = *(const V*)&gradients.data[(3 * a + 1) * 8 + q];
            const V g2 = *(const V*)&gradients.data[(3 * a + 2) * 8 + q];
            for (int i = 0; i < 3; ++i) {
                const float value = VALUES[3 * a + i];
                INTO[3 * i + 0] += value * g0;
                INTO[3 * i + 1] += value * g1;
                INTO[3 * i + 2] += value * g2;
            }
        }
        for (int k = 0; k < 9; ++k) INTO[k] = INTO[k] * scale[k % 3];
"""

LOAD_MODULI = r"""
        V c[MODULI];
        for (int m = 0; m < MODULI; ++m) c[m] = *(const V*)&moduli_volume.data[(cell * MODULI + m) * 8 + q];
"""

COFACTOR = r"""
        S F[9], cof[9];
        for (int k = 0; k < 9; ++k) F[k] = k % 4 == 0 ? H[k] + 1.0f : H[k];
        cof[0] = F[4] * F[8] - F[5] * F[7];
        cof[1] = F[5] * F[6] - F[3] * F[8];
        cof[2] = F[3] * F[7] - F[4] * F[6];
        cof[3] = F[2] * F[7] - F[1] * F[8];
        cof[4] = F[0] * F[8] - F[2] * F[6];
        cof[5] = F[1] * F[6] - F[0] * F[7];
        cof[6] = F[1] * F[5] - F[2] * F[4];
        cof[7] = F[2] * F[3] - F[0] * F[5];
        cof[8] = F[0] * F[4] - F[1] * F[3];
        S J = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2];
        J = lane::where_positive(c[0], J, V{} + 1.0f);   // without material no stress, however the particle turns
"""

FLOOR_J = "        J = lane::floor(J, 0.02f);\n"

_REPORT = r"""
        if (lane::any_below(J, 0.02f)) inverted.data[cell] = 1;
"""

_VISCOSITY = r"""
        if (viscous) {
            const V etaV = *(const V*)&eta_volume.data[cell * 8 + q];
            const V invJ = 1.0f / lane::floor(J, 0.02f);
            V* old = (V*)&previous.data[cell * 72 + q];   // 9 rows of 8 lanes
            V rate[9];
            for (int k = 0; k < 9; ++k) {
                V* row = (V*)((float*)old + 8 * k);
                rate[k] = (F[k] - *row) * inv_dt;
                *row = F[k];
            }
            V L[9];   // velocity gradient L = Fdot F^-1 = Fdot cof^T / J
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    L[3 * i + j] = (rate[3 * i] * cof[3 * j] + rate[3 * i + 1] * cof[3 * j + 1]
                                    + rate[3 * i + 2] * cof[3 * j + 2]) * invJ;
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    for (int k = 0; k < 3; ++k)
                        P[3 * i + j] += etaV * (L[3 * i + k] + L[3 * k + i]) * cof[3 * k + j];
        }
"""

_SCATTER = r"""
        for (int k = 0; k < 9; ++k) STRESS[k] = STRESS[k] * scale[k % 3];
        for (int a = 0; a < 27; ++a) {
            const V g0 = *(const V*)&gradients.data[(3 * a + 0) * 8 + q];
            const V g1 = *(const V*)&gradients.data[(3 * a + 1) * 8 + q];
            const V g2 = *(const V*)&gradients.data[(3 * a + 2) * 8 + q];
            for (int i = 0; i < 3; ++i) {
                const V t = STRESS[3 * i] * g0 + STRESS[3 * i + 1] * g1 + STRESS[3 * i + 2] * g2;
                PW_ADD(OUT.data[3 * node[a] + i], SIGN lane::sum(t));
            }
        }
"""


def gradient(values: str, into: str) -> str:
    """The text that finds the gradient ``into``[9] of 27 nodal vectors ``values`` at the particles."""
    return _GRADIENT.replace("VALUES", values).replace("INTO", into)


def scatter(stress: str, out: str, sign: str = "-") -> str:
    """The text that adds ``sign`` the nodal forces of ``stress``[9] to ``out``; it scales the stress in place."""
    return _SCATTER.replace("STRESS", stress).replace("OUT", out).replace("SIGN", sign)


def _snippet(stress: Stress, moduli: int) -> str:
    return (
        lanes_float8(stress.helpers)
        + f"    const int MODULI = {moduli};\n    typedef V S;\n    const float* number = numbers.data;\n"
        + LOAD_DISPLACEMENTS
        + "    for (int q = 0; q < 8; q += LANES) {\n"
        + gradient("u", "H")
        + LOAD_MODULI
        + COFACTOR
        + (_REPORT + FLOOR_J if stress.infinite_at_inversion else "")
        + f"        V P[9];\n        {{\n{stress.body}\n        }}\n"
        + _VISCOSITY
        + scatter("P", "force")
        + "    }\n"
    )


@cache
def solid_forces(stress: Stress, moduli: int) -> wp.Kernel:
    """The kernel that adds the internal forces [N] of one cell to its 27 nodes; ``clock[1]`` is 1/dt [1/s].

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
        inv_dt: float,
        # in
        x: wp.array[wp.float64],
        # in, out
        previous: wp.array[wp.float32],
        # out
        force: wp.array[wp.float64],
        inverted: wp.array[wp.int32],
    ) -> None: ...

    @wp.kernel(module=f"physworld_solid_{stress.name}", enable_backward=False)
    def forces(
        # model
        cell_nodes: wp.array[wp.int32],
        gradients: wp.array[wp.float32],
        x_rest: wp.array[wp.float64],
        moduli_volume: wp.array[wp.float32],
        eta_volume: wp.array[wp.float32],
        numbers: wp.array[wp.float32],
        inv_dx: wp.vec3f,
        viscous: int,
        clock: wp.array[wp.float64],
        # in
        x: wp.array[wp.float64],
        # in, out
        previous: wp.array[wp.float32],
        # out
        force: wp.array[wp.float64],
        inverted: wp.array[wp.int32],
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
            wp.float32(clock[1]),
            x,
            previous,
            force,
            inverted,
        )

    return forces
