"""Device side of ropes and rods: stretch and bending forces of a rod that is straight at rest.

    W = EA / 2 (|x'| - 1)^2 + B / 2 |k|^2     k = x' x x'' / |x'|^3     B = EI

The rod is isotropic, so its twist decouples but for the ends that grips hold (:mod:`physworld.engine.thin.twist`).
Internal friction is of Kelvin-Voigt kind with the time tau, on the corotational rate of bending, so that a rigid turn
dissipates nothing. One cell a thread, its 2 particles are the lanes. The pieces of the text are written over a type S
and shared with the tangent (:mod:`physworld.engine.gradients.thin_tangent_kernels`).

Legend: t = x', c = x'' at a particle; St, Sc the forces on them; EA, B stiffnesses times the particle's length.
"""

from __future__ import annotations

import warp as wp

from physworld.engine.lattice.lanes import lanes_double

_LOAD = r"""
        for (int i = 0; i < 3; ++i) T_[i] = C_[i] = V{};
        for (int a = 0; a < 3; ++a) {
            const V g = *(const V*)&derivatives.data[(2 * a) * 2 + q];
            const V h = *(const V*)&derivatives.data[(2 * a + 1) * 2 + q];
            for (int i = 0; i < 3; ++i) {
                T_[i] += VALUES.data[3 * node[a] + i] * g;
                C_[i] += VALUES.data[3 * node[a] + i] * h;
            }
        }
"""

PRODUCTS = r"""
        #define PW_DOT(u, w) ((u)[0] * (w)[0] + (u)[1] * (w)[1] + (u)[2] * (w)[2])
        #define PW_CROSS(out, u, w) S out[3] = {(u)[1] * (w)[2] - (u)[2] * (w)[1], \
            (u)[2] * (w)[0] - (u)[0] * (w)[2], (u)[0] * (w)[1] - (u)[1] * (w)[0]}
"""

MODULI = (
    PRODUCTS
    + r"""
        const V EA = *(const V*)&stretching.data[cell * 2 + q];
        const V B = *(const V*)&bending.data[cell * 2 + q];
"""
)

ELASTIC = r"""
        const S a2 = PW_DOT(t, t) + 1e-24;
        const S inv_a2 = lane::inverse(a2);
        PW_CROSS(w, t, c);
        PW_CROSS(wt, w, t);
        PW_CROSS(cw, c, w);
        const S turn = PW_DOT(w, w) * inv_a2 * 3.0;
        const S bend = inv_a2 * inv_a2 * inv_a2 * B;
        const S pull = (lane::sqrt(inv_a2) * -1.0 + 1.0) * EA;   // EA (|t| - 1) / |t|
        S St[3], Sc[3];
        for (int i = 0; i < 3; ++i) {
            Sc[i] = bend * wt[i];
            St[i] = bend * (cw[i] - turn * t[i]) + pull * t[i];
        }
"""

FRICTION = r"""
            PW_CROSS(spin, t, td);
            for (int i = 0; i < 3; ++i) spin[i] = spin[i] * inv_a2;
            PW_CROSS(carried, spin, c);
            V co[3] = {cd[0] - carried[0], cd[1] - carried[1], cd[2] - carried[2]};
            const V along = PW_DOT(t, co) * inv_a2;
            V Gc[3], Gt[3];
            for (int i = 0; i < 3; ++i) Gc[i] = B * tau * inv_a2 * inv_a2 * (co[i] - along * t[i]);
            PW_CROSS(z, c, Gc);
            PW_CROSS(zt, z, t);
            for (int i = 0; i < 3; ++i) Gt[i] = -zt[i] * inv_a2;
"""

_SCATTER = r"""
        for (int a = 0; a < 3; ++a) {
            const V g = *(const V*)&derivatives.data[(2 * a) * 2 + q];
            const V h = *(const V*)&derivatives.data[(2 * a + 1) * 2 + q];
            for (int i = 0; i < 3; ++i)
                PW_ADD(OUT.data[3 * node[a] + i], SIGN lane::sum(ON_T[i]MEMBER * g + ON_C[i]MEMBER * h));
        }
"""


def scatter(out: str, on_t: str, on_c: str, sign: str = "-", member: str = "") -> str:
    """The text that adds the forces of a cell to its nodes.

    Args:
        out: name of the array that they are added to.
        on_t, on_c: names of the forces by x' and by x''.
        sign: "-" or "+".
        member: suffix that takes one number out of each force.
    """
    text = _SCATTER.replace("OUT", out).replace("ON_T", on_t).replace("ON_C", on_c)
    return text.replace("SIGN", sign).replace("MEMBER", member)


def load(values: str, t: str, c: str) -> str:
    """The text that finds x' and x'' of the nodal ``values``."""
    return _LOAD.replace("VALUES", values).replace("T_", t).replace("C_", c)


_SNIPPET = (
    lanes_double(2)
    + r"""
    typedef V S;
    const int* node = &cell_nodes.data[cell * 3];
    for (int q = 0; q < 2; q += LANES) {
        V t[3], c[3];
"""
    + load("x", "t", "c")
    + MODULI
    + ELASTIC
    + r"""
        if (viscous) {
            V rate[6];
            for (int k = 0; k < 6; ++k) {
                V* row = (V*)&previous.data[(cell * 6 + k) * 2 + q];
                const V now = k < 3 ? t[k] : c[k - 3];
                rate[k] = (now - *row) * inv_dt;
                *row = now;
            }
            const V* td = rate;
            const V* cd = rate + 3;
"""
    + FRICTION
    + r"""
            for (int i = 0; i < 3; ++i) {
                Sc[i] += Gc[i];
                St[i] += Gt[i];
            }
        }
"""
    + scatter("force", "St", "Sc")
    + "    }\n"
)


@wp.func_native(_SNIPPET)
def rod_cell(
    cell: int,
    # model
    cell_nodes: wp.array[wp.int32],
    derivatives: wp.array[wp.float64],
    stretching: wp.array[wp.float64],
    bending: wp.array[wp.float64],
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
def rod_forces(
    # model
    cell_nodes: wp.array[wp.int32],
    derivatives: wp.array[wp.float64],
    stretching: wp.array[wp.float64],
    bending: wp.array[wp.float64],
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
    """Add the internal forces [N] of one cell to its 3 nodes; ``clock[1]`` is 1/dt [1/s]."""
    rod_cell(
        wp.tid(), cell_nodes, derivatives, stretching, bending, tau, viscous, clock[1], x, previous, force
    )
