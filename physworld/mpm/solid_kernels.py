"""Device side of elastic solids: internal forces of a compressible neo-Hookean body, one cell a thread.

    P = mu (F - F^-T) + lambda ln(J) F^-T + 2 eta d J F^-T          (first Piola-Kirchhoff, Kelvin-Voigt viscosity)
    f_a -= sum_q V_q P(F_q) grad N_a(q)

The 8 particles of a cell are the 8 lanes of a vector; the B-spline gradients at them are the same 27 x 3 x 8 numbers
in every cell. On a CPU the lanes are one SIMD register, on CUDA they are a loop. Displacements are taken relative to
the cell's middle node before they are rounded to single precision (the gradients of a constant vanish), so a strain
keeps 7 digits wherever the body is.

Legend: F deformation gradient, J its determinant, cof = J F^-T, G gradients of the weights in units of the cell.
"""

from __future__ import annotations

import warp as wp

from physworld.mpm.lanes import LANES_FLOAT8

_SNIPPET = (
    LANES_FLOAT8
    + r"""
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
    for (int q = 0; q < 8; q += LANES) {
        V F[9];
        for (int k = 0; k < 9; ++k) F[k] = V{};
        for (int a = 0; a < 27; ++a) {
            const V g0 = *(const V*)&gradients.data[(3 * a + 0) * 8 + q];
            const V g1 = *(const V*)&gradients.data[(3 * a + 1) * 8 + q];
            const V g2 = *(const V*)&gradients.data[(3 * a + 2) * 8 + q];
            for (int i = 0; i < 3; ++i) {
                const float ui = u[3 * a + i];
                F[3 * i + 0] += ui * g0;
                F[3 * i + 1] += ui * g1;
                F[3 * i + 2] += ui * g2;
            }
        }
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) F[3 * i + j] = F[3 * i + j] * scale[j];
            F[4 * i] += 1.0f;
        }
        V cof[9];
        cof[0] = F[4] * F[8] - F[5] * F[7];
        cof[1] = F[5] * F[6] - F[3] * F[8];
        cof[2] = F[3] * F[7] - F[4] * F[6];
        cof[3] = F[2] * F[7] - F[1] * F[8];
        cof[4] = F[0] * F[8] - F[2] * F[6];
        cof[5] = F[1] * F[6] - F[0] * F[7];
        cof[6] = F[1] * F[5] - F[2] * F[4];
        cof[7] = F[2] * F[3] - F[0] * F[5];
        cof[8] = F[0] * F[4] - F[1] * F[3];
        const int p = cell * 8 + q;
        const V muV = *(const V*)&mu_volume.data[p];
        V J = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2];
        J = PW_WHERE_POSITIVE(muV, J, 1.0f);   // a particle without material carries no stress, however it turns
        if (PW_ANY_BELOW(J, 0.02f)) {
            inverted.data[0] = 1;
            J = PW_FLOOR(J, 0.02f);
        }
        const V lamV = *(const V*)&lambda_volume.data[p];
        const V invJ = 1.0f / J;
        const V pressure = (lamV * PW_LOG(J) - muV) * invJ;
        V P[9];
        for (int k = 0; k < 9; ++k) P[k] = muV * F[k] + pressure * cof[k];
        if (viscous) {
            const V etaV = *(const V*)&eta_volume.data[p];
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
        for (int k = 0; k < 9; ++k) P[k] = P[k] * scale[k % 3];
        for (int a = 0; a < 27; ++a) {
            const V g0 = *(const V*)&gradients.data[(3 * a + 0) * 8 + q];
            const V g1 = *(const V*)&gradients.data[(3 * a + 1) * 8 + q];
            const V g2 = *(const V*)&gradients.data[(3 * a + 2) * 8 + q];
            for (int i = 0; i < 3; ++i) {
                const V t = P[3 * i] * g0 + P[3 * i + 1] * g1 + P[3 * i + 2] * g2;
                PW_ADD(force.data[3 * node[a] + i], -PW_SUM(t));
            }
        }
    }
"""
)


@wp.func_native(_SNIPPET)
def solid_cell(
    cell: int,
    # model
    cell_nodes: wp.array(dtype=wp.int32),
    gradients: wp.array(dtype=wp.float32),
    x_rest: wp.array(dtype=wp.float64),
    mu_volume: wp.array(dtype=wp.float32),
    lambda_volume: wp.array(dtype=wp.float32),
    eta_volume: wp.array(dtype=wp.float32),
    inv_dx0: float,
    inv_dx1: float,
    inv_dx2: float,
    viscous: int,
    inv_dt: float,
    # in
    x: wp.array(dtype=wp.float64),
    # in, out
    previous: wp.array(dtype=wp.float32),
    # out
    force: wp.array(dtype=wp.float64),
    inverted: wp.array(dtype=wp.int32),
): ...


@wp.kernel
def solid_forces(
    # model
    cell_nodes: wp.array(dtype=wp.int32),
    gradients: wp.array(dtype=wp.float32),
    x_rest: wp.array(dtype=wp.float64),
    mu_volume: wp.array(dtype=wp.float32),
    lambda_volume: wp.array(dtype=wp.float32),
    eta_volume: wp.array(dtype=wp.float32),
    inv_dx: wp.vec3f,
    viscous: int,
    clock: wp.array(dtype=wp.float64),
    # in
    x: wp.array(dtype=wp.float64),
    # in, out
    previous: wp.array(dtype=wp.float32),
    # out
    force: wp.array(dtype=wp.float64),
    inverted: wp.array(dtype=wp.int32),
):
    """Add the internal forces [N] of one cell to its 27 nodes; ``clock[1]`` is 1/dt [1/s]."""
    solid_cell(
        wp.tid(),
        cell_nodes,
        gradients,
        x_rest,
        mu_volume,
        lambda_volume,
        eta_volume,
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
