"""Device side of internal friction alone: forces -C(x) v of Kelvin-Voigt kind, linear in the velocities v.

    solid   P = 2 eta d J F^-T = (G B^T + B G^T) B        G = dF/dt, B = J F^-T sqrt(eta / J)
    sheet   N = tau K C de/dt, M = tau D B dk/dt           (the law's own stiffness on the rates of its strains)
    rod     tau B on the corotational rate of bending

C is symmetric and positive semidefinite, and silent in rigid motion. These are the frictions of
:mod:`physworld.engine.total.solid_kernels`, :mod:`physworld.engine.thin.sheet_kernels` and
:mod:`physworld.engine.thin.rod_kernels` with the rates taken from velocities instead of from the last substep; a scheme
that applies C many times at one place needs them so (:mod:`physworld.engine.total.relaxation`). A solid's B is found
once a place and kept.
"""

from __future__ import annotations

import warp as wp

from physworld.engine.lattice.lanes import lanes_double, lanes_float8
from physworld.engine.thin import rod_kernels, sheet_kernels
from physworld.engine.total.solid_kernels import COFACTOR, LOAD_DISPLACEMENTS, gradient, scatter

_PREPARE = (
    lanes_float8()
    + "    typedef V S;\n"
    + LOAD_DISPLACEMENTS
    + "    for (int q = 0; q < 8; q += LANES) {\n"
    + gradient("u", "H")
    + "        const V c[1] = {*(const V*)&eta_volume.data[cell * 8 + q]};\n"
    + COFACTOR
    + r"""
        const V root = lane::sqrt(c[0] / lane::floor(J, 0.02f));
        for (int k = 0; k < 9; ++k) *(V*)&turned.data[(cell * 9 + k) * 8 + q] = cof[k] * root;
    }
"""
)

_SOLID = (
    lanes_float8()
    + r"""
    const int* node = &cell_nodes.data[cell * 27];
    const double* anchor = &v.data[3 * node[13]];
    float w[27 * 3];
    for (int a = 0; a < 27; ++a)
        for (int i = 0; i < 3; ++i) w[3 * a + i] = (float)(v.data[3 * node[a] + i] - anchor[i]);
    const float scale[3] = {inv_dx0, inv_dx1, inv_dx2};
    for (int q = 0; q < 8; q += LANES) {
"""
    + gradient("w", "G")
    + r"""
        V B[9], A[9], P[9];
        for (int k = 0; k < 9; ++k) B[k] = *(const V*)&turned.data[(cell * 9 + k) * 8 + q];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                A[3 * i + j] = G[3 * i] * B[3 * j] + G[3 * i + 1] * B[3 * j + 1] + G[3 * i + 2] * B[3 * j + 2];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                P[3 * i + j] = V{};
                for (int k = 0; k < 3; ++k) P[3 * i + j] += (A[3 * i + k] + A[3 * k + i]) * B[3 * k + j];
            }
"""
    + scatter("P", "force")
    + "    }\n"
)

_SHEET = (
    lanes_double(4)
    + r"""
    typedef V S;
    const int* node = &cell_nodes.data[cell * 9];
    for (int q = 0; q < 4; q += LANES) {
        V d[5][3], r[5][3];
"""
    + sheet_kernels.load("x", "d")
    + sheet_kernels.load("v", "r")
    + sheet_kernels.SURFACE
    + r"""
        V a1[3], a2[3];   // contravariant tangents
        for (int i = 0; i < 3; ++i) {
            a1[i] = (g22 * d[0][i] - g12 * d[1][i]) * inv_det;
            a2[i] = (g11 * d[1][i] - g12 * d[0][i]) * inv_det;
        }
        const V turn1 = PW_DOT(n, r[0]), turn2 = PW_DOT(n, r[1]);   // the normal turns by - turn1 a1 - turn2 a2
        strain[0] = PW_DOT(d[0], r[0]) * tau;
        strain[1] = PW_DOT(d[1], r[1]) * tau;
        strain[2] = (PW_DOT(d[0], r[1]) + PW_DOT(d[1], r[0])) * (0.5 * tau);
        for (int k = 0; k < 3; ++k)
            strain[3 + k] = (PW_DOT(n, r[2 + k]) - turn1 * PW_DOT(a1, d[2 + k]) - turn2 * PW_DOT(a2, d[2 + k])) * tau;
"""
    + sheet_kernels.MODULI
    + "        V N[6];\n        PW_RESULTANTS(N, strain)\n"
    + sheet_kernels.LOADS
    + sheet_kernels.scatter("force")
    + "    }\n"
)

_ROD = (
    lanes_double(2)
    + r"""
    typedef V S;
    const int* node = &cell_nodes.data[cell * 3];
    for (int q = 0; q < 2; q += LANES) {
        V t[3], c[3], td[3], cd[3];
"""
    + rod_kernels.load("x", "t", "c")
    + rod_kernels.load("v", "td", "cd")
    + r"""
        const V B = *(const V*)&bending.data[cell * 2 + q];
"""
    + rod_kernels.PRODUCTS
    + r"""
        const V inv_a2 = 1.0 / (PW_DOT(t, t) + 1e-24);
"""
    + rod_kernels.FRICTION
    + rod_kernels.scatter("force", "Gt", "Gc")
    + "    }\n"
)


@wp.func_native(_PREPARE)
def prepare_cell(
    cell: int,
    # model
    cell_nodes: wp.array[wp.int32],
    gradients: wp.array[wp.float32],
    x_rest: wp.array[wp.float64],
    eta_volume: wp.array[wp.float32],
    inv_dx0: float,
    inv_dx1: float,
    inv_dx2: float,
    # in
    x: wp.array[wp.float64],
    # out
    turned: wp.array[wp.float32],
) -> None: ...


@wp.func_native(_SOLID)
def solid_cell(
    cell: int,
    # model
    cell_nodes: wp.array[wp.int32],
    gradients: wp.array[wp.float32],
    inv_dx0: float,
    inv_dx1: float,
    inv_dx2: float,
    turned: wp.array[wp.float32],
    # in
    v: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None: ...


@wp.func_native(_SHEET)
def sheet_cell(
    cell: int,
    # model
    cell_nodes: wp.array[wp.int32],
    derivatives: wp.array[wp.float64],
    membrane: wp.array[wp.float64],
    bending: wp.array[wp.float64],
    shape: wp.array[wp.float64],
    tau: wp.float64,
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None: ...


@wp.func_native(_ROD)
def rod_cell(
    cell: int,
    # model
    cell_nodes: wp.array[wp.int32],
    derivatives: wp.array[wp.float64],
    bending: wp.array[wp.float64],
    tau: wp.float64,
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None: ...


@wp.kernel(enable_backward=False)
def prepare_solid_friction(
    # model
    cell_nodes: wp.array[wp.int32],
    gradients: wp.array[wp.float32],
    x_rest: wp.array[wp.float64],
    eta_volume: wp.array[wp.float32],
    inv_dx: wp.vec3f,
    # in
    x: wp.array[wp.float64],
    # out
    turned: wp.array[wp.float32],
) -> None:
    """Keep B of the particles of one cell at nodal positions ``x``."""
    prepare_cell(
        wp.tid(), cell_nodes, gradients, x_rest, eta_volume, inv_dx[0], inv_dx[1], inv_dx[2], x, turned
    )


@wp.kernel(enable_backward=False)
def solid_friction(
    # model
    cell_nodes: wp.array[wp.int32],
    gradients: wp.array[wp.float32],
    inv_dx: wp.vec3f,
    turned: wp.array[wp.float32],
    # in
    v: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Add the friction [N] of one cell to its 27 nodes, where B was kept."""
    solid_cell(wp.tid(), cell_nodes, gradients, inv_dx[0], inv_dx[1], inv_dx[2], turned, v, force)


@wp.kernel(enable_backward=False)
def sheet_friction(
    # model
    cell_nodes: wp.array[wp.int32],
    derivatives: wp.array[wp.float64],
    membrane: wp.array[wp.float64],
    bending: wp.array[wp.float64],
    shape: wp.array[wp.float64],
    tau: wp.float64,
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Add the friction [N] of one cell to its 9 nodes."""
    sheet_cell(wp.tid(), cell_nodes, derivatives, membrane, bending, shape, tau, x, v, force)


@wp.kernel(enable_backward=False)
def rod_friction(
    # model
    cell_nodes: wp.array[wp.int32],
    derivatives: wp.array[wp.float64],
    bending: wp.array[wp.float64],
    tau: wp.float64,
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Add the friction [N] of one cell to its 3 nodes."""
    rod_cell(wp.tid(), cell_nodes, derivatives, bending, tau, x, v, force)
