"""Device side of thin sheets: membrane and bending forces of a Kirchhoff-Love shell that is flat at rest.

    N = K C e, M = D B k      e_ab = (a_a . a_b - delta_ab) / 2      k_ab = n . x,ab

a_a = dx/dX_a are the tangents, n the unit normal (Koiter 1966; Kiendl et al. 2009 for splines: the C1 basis needs no
rotations); C and B are the orthotropic shapes of :mod:`physworld.materials.sheet`. Internal friction is of Kelvin-Voigt
kind: strains are replaced by e + tau de/dt. One cell a thread, its 4 particles are the lanes of a vector; double
precision, since bending takes second derivatives. The pieces of the text are written over a type S and shared with the
tangent (:mod:`physworld.engine.gradients.thin_tangent_kernels`).
"""

from __future__ import annotations

import warp as wp

from physworld.engine.lattice.lanes import lanes_double

_LOAD = r"""
        for (int k = 0; k < 5; ++k)
            for (int i = 0; i < 3; ++i) INTO[k][i] = V{};
        for (int a = 0; a < 9; ++a)
            for (int k = 0; k < 5; ++k) {
                const V g = *(const V*)&derivatives.data[(5 * a + k) * 4 + q];
                for (int i = 0; i < 3; ++i) INTO[k][i] += VALUES.data[3 * node[a] + i] * g;
            }
"""

SURFACE = r"""
        #define PW_DOT(u, w) ((u)[0] * (w)[0] + (u)[1] * (w)[1] + (u)[2] * (w)[2])
        const S g11 = PW_DOT(d[0], d[0]), g22 = PW_DOT(d[1], d[1]), g12 = PW_DOT(d[0], d[1]);
        S n[3] = {d[0][1] * d[1][2] - d[0][2] * d[1][1], d[0][2] * d[1][0] - d[0][0] * d[1][2],
                  d[0][0] * d[1][1] - d[0][1] * d[1][0]};
        const S inv_det = lane::inverse(PW_DOT(n, n) + 1e-24);
        const S inv_area = lane::sqrt(inv_det);
        for (int i = 0; i < 3; ++i) n[i] = n[i] * inv_area;
        S strain[6] = {(g11 - 1.0) * 0.5, (g22 - 1.0) * 0.5, g12 * 0.5,
                       PW_DOT(n, d[2]), PW_DOT(n, d[3]), PW_DOT(n, d[4])};
"""

MODULI = r"""
        const V K = *(const V*)&membrane.data[cell * 4 + q];
        const V Kb = *(const V*)&bending.data[cell * 4 + q];
        const double* C = shape.data;   // C11, C22, C12, C33, then those of bending
        #define PW_RESULTANTS(out, e) { \
            out[0] = (e[0] * C[0] + e[1] * C[2]) * K; \
            out[1] = (e[0] * C[2] + e[1] * C[1]) * K; \
            out[2] = e[2] * (K * C[3]); \
            out[3] = (e[3] * C[4] + e[4] * C[6]) * Kb; \
            out[4] = (e[3] * C[6] + e[4] * C[5]) * Kb; \
            out[5] = e[5] * (Kb * C[7]); }
"""

LOADS = r"""
        S first = d[0][0] * 0.0, second = first;   // moments times contravariant tangents: what turns the normal
        for (int i = 0; i < 3; ++i) {
            const S load = N[3] * d[2][i] + N[4] * d[3][i] + N[5] * d[4][i] * 2.0;
            first = first + load * (g22 * d[0][i] - g12 * d[1][i]) * inv_det;
            second = second + load * (g11 * d[1][i] - g12 * d[0][i]) * inv_det;
        }
        S T[5][3];
        for (int i = 0; i < 3; ++i) {
            T[0][i] = N[0] * d[0][i] + N[2] * d[1][i] - first * n[i];
            T[1][i] = N[1] * d[1][i] + N[2] * d[0][i] - second * n[i];
            T[2][i] = N[3] * n[i];
            T[3][i] = N[4] * n[i];
            T[4][i] = N[5] * n[i] * 2.0;
        }
"""

_SCATTER = r"""
        for (int a = 0; a < 9; ++a) {
            V f[3] = {V{}, V{}, V{}};
            for (int k = 0; k < 5; ++k) {
                const V g = *(const V*)&derivatives.data[(5 * a + k) * 4 + q];
                for (int i = 0; i < 3; ++i) f[i] += T[k][i]MEMBER * g;
            }
            for (int i = 0; i < 3; ++i) PW_ADD(OUT.data[3 * node[a] + i], SIGN lane::sum(f[i]));
        }
"""


def scatter(out: str, sign: str = "-", member: str = "") -> str:
    """The text that adds ``sign`` the forces T of a cell to the nodes of ``out``."""
    return _SCATTER.replace("OUT", out).replace("SIGN", sign).replace("MEMBER", member)


def load(values: str, into: str) -> str:
    """The text that finds the derivatives of the nodal ``values``: a1, a2, x,11, x,22 and x,12."""
    return _LOAD.replace("VALUES", values).replace("INTO", into)


_SNIPPET = (
    lanes_double(4)
    + r"""
    typedef V S;
    const int* node = &cell_nodes.data[cell * 9];
    for (int q = 0; q < 4; q += LANES) {
        V d[5][3];
"""
    + load("x", "d")
    + SURFACE
    + r"""
        if (viscous) {
            for (int k = 0; k < 6; ++k) {
                V* row = (V*)&previous.data[(cell * 6 + k) * 4 + q];
                const V now = strain[k];
                strain[k] = now + (now - *row) * (tau * inv_dt);
                *row = now;
            }
        }
"""
    + MODULI
    + "        V N[6];\n        PW_RESULTANTS(N, strain)\n"
    + LOADS
    + scatter("force")
    + "    }\n"
)


@wp.func_native(_SNIPPET)
def sheet_cell(
    cell: int,
    # model
    cell_nodes: wp.array[wp.int32],
    derivatives: wp.array[wp.float64],
    membrane: wp.array[wp.float64],
    bending: wp.array[wp.float64],
    shape: wp.array[wp.float64],
    tau: wp.float64,
    viscous: int,
    inv_dt: wp.float64,
    # in
    x: wp.array[wp.float64],
    # in, out
    previous: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None: ...


@wp.kernel(enable_backward=False)
def sheet_forces(
    # model
    cell_nodes: wp.array[wp.int32],
    derivatives: wp.array[wp.float64],
    membrane: wp.array[wp.float64],
    bending: wp.array[wp.float64],
    shape: wp.array[wp.float64],
    tau: wp.float64,
    viscous: int,
    clock: wp.array[wp.float64],
    # in
    x: wp.array[wp.float64],
    # in, out
    previous: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Add the internal forces [N] of one cell to its 9 nodes; ``clock[1]`` is 1/dt [1/s]."""
    sheet_cell(
        wp.tid(),
        cell_nodes,
        derivatives,
        membrane,
        bending,
        shape,
        tau,
        viscous,
        clock[1],
        x,
        previous,
        force,
    )
