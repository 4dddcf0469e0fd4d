"""Device side of thin sheets: membrane and bending forces of a Kirchhoff-Love shell that is flat at rest.

    W = h E / (2 (1 - nu^2)) [nu (tr e)^2 + (1 - nu) e:e] + D / 2 [nu (tr k)^2 + (1 - nu) k:k]
    e_ab = (a_a . a_b - delta_ab) / 2     k_ab = n . x,ab     D = h^3 E / 12 (1 - nu^2) unless given apart

a_a = dx/dX_a are the tangents, n the unit normal (Koiter 1966; Kiendl et al. 2009 for splines: the C1 basis needs no
rotations). Internal friction is of Kelvin-Voigt kind: strains are replaced by e + tau de/dt. One cell a thread, its
4 particles are the lanes of a vector; double precision, since bending takes second derivatives.
"""

from __future__ import annotations

import warp as wp

from physworld.mpm.lanes import lanes_double

_SNIPPET = (
    lanes_double(4)
    + r"""
    const int* node = &cell_nodes.data[cell * 9];
    for (int q = 0; q < 4; q += LANES) {
        V d[5][3];   // a1, a2, x,11, x,22, x,12
        for (int k = 0; k < 5; ++k)
            for (int i = 0; i < 3; ++i) d[k][i] = V{};
        for (int a = 0; a < 9; ++a)
            for (int k = 0; k < 5; ++k) {
                const V g = *(const V*)&derivatives.data[(5 * a + k) * 4 + q];
                for (int i = 0; i < 3; ++i) d[k][i] += x.data[3 * node[a] + i] * g;
            }
        #define PW_DOT(u, w) ((u)[0] * (w)[0] + (u)[1] * (w)[1] + (u)[2] * (w)[2])
        const V g11 = PW_DOT(d[0], d[0]), g22 = PW_DOT(d[1], d[1]), g12 = PW_DOT(d[0], d[1]);
        V n[3] = {d[0][1] * d[1][2] - d[0][2] * d[1][1], d[0][2] * d[1][0] - d[0][0] * d[1][2],
                  d[0][0] * d[1][1] - d[0][1] * d[1][0]};
        const V area2 = PW_DOT(n, n) + 1e-24;
        const V inv_area = 1.0 / PW_SQRT(area2);
        for (int i = 0; i < 3; ++i) n[i] = n[i] * inv_area;
        V strain[6] = {0.5 * (g11 - 1.0), 0.5 * (g22 - 1.0), 0.5 * g12,
                       PW_DOT(n, d[2]), PW_DOT(n, d[3]), PW_DOT(n, d[4])};
        if (viscous) {
            for (int k = 0; k < 6; ++k) {
                V* row = (V*)&previous.data[(cell * 6 + k) * 4 + q];
                const V now = strain[k];
                strain[k] = now + (now - *row) * (tau * inv_dt);
                *row = now;
            }
        }
        const V K = *(const V*)&membrane.data[cell * 4 + q];
        const V D = *(const V*)&bending.data[cell * 4 + q];
        const V N11 = K * (strain[0] + nu * strain[1]), N22 = K * (strain[1] + nu * strain[0]);
        const V N12 = K * (1.0 - nu) * strain[2];
        const V M11 = D * (strain[3] + nu * strain[4]), M22 = D * (strain[4] + nu * strain[3]);
        const V M12 = D * (1.0 - nu) * strain[5];
        const V inv_det = 1.0 / area2;
        V first = V{}, second = V{};   // moments times the contravariant tangents: what turns the normal
        for (int i = 0; i < 3; ++i) {
            const V load = M11 * d[2][i] + M22 * d[3][i] + 2.0 * M12 * d[4][i];
            first += load * (g22 * d[0][i] - g12 * d[1][i]) * inv_det;
            second += load * (g11 * d[1][i] - g12 * d[0][i]) * inv_det;
        }
        V S[5][3];
        for (int i = 0; i < 3; ++i) {
            S[0][i] = N11 * d[0][i] + N12 * d[1][i] - first * n[i];
            S[1][i] = N22 * d[1][i] + N12 * d[0][i] - second * n[i];
            S[2][i] = M11 * n[i];
            S[3][i] = M22 * n[i];
            S[4][i] = 2.0 * M12 * n[i];
        }
        for (int a = 0; a < 9; ++a) {
            V f[3] = {V{}, V{}, V{}};
            for (int k = 0; k < 5; ++k) {
                const V g = *(const V*)&derivatives.data[(5 * a + k) * 4 + q];
                for (int i = 0; i < 3; ++i) f[i] += S[k][i] * g;
            }
            for (int i = 0; i < 3; ++i) PW_ADD(force.data[3 * node[a] + i], -PW_SUM(f[i]));
        }
    }
"""
)


@wp.func_native(_SNIPPET)
def sheet_cell(
    cell: int,
    # model
    cell_nodes: wp.array(dtype=wp.int32),
    derivatives: wp.array(dtype=wp.float64),
    membrane: wp.array(dtype=wp.float64),
    bending: wp.array(dtype=wp.float64),
    nu: wp.float64,
    tau: wp.float64,
    viscous: int,
    inv_dt: wp.float64,
    # in
    x: wp.array(dtype=wp.float64),
    # in, out
    previous: wp.array(dtype=wp.float64),
    # out
    force: wp.array(dtype=wp.float64),
): ...


@wp.kernel
def sheet_forces(
    # model
    cell_nodes: wp.array(dtype=wp.int32),
    derivatives: wp.array(dtype=wp.float64),
    membrane: wp.array(dtype=wp.float64),
    bending: wp.array(dtype=wp.float64),
    nu: wp.float64,
    tau: wp.float64,
    viscous: int,
    clock: wp.array(dtype=wp.float64),
    # in
    x: wp.array(dtype=wp.float64),
    # in, out
    previous: wp.array(dtype=wp.float64),
    # out
    force: wp.array(dtype=wp.float64),
):
    """Add the internal forces [N] of one cell to its 9 nodes; ``clock[1]`` is 1/dt [1/s]."""
    sheet_cell(
        wp.tid(), cell_nodes, derivatives, membrane, bending, nu, tau, viscous, clock[1], x, previous, force
    )
