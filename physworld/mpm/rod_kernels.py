"""Device side of ropes and rods: stretch and bending forces of a rod that is straight at rest.

    W = EA / 2 (|x'| - 1)^2 + B / 2 |k|^2     k = x' x x'' / |x'|^3     B = EI

The rod is isotropic and its ends do not twist it, so twist decouples and is not carried (Bergou et al. 2008, the
twist-free case). Internal friction is of Kelvin-Voigt kind with the time tau, on the corotational rate of bending, so
that a rigid turn dissipates nothing. One cell a thread, its 2 particles are the lanes.
"""

from __future__ import annotations

import warp as wp

from physworld.mpm.lanes import lanes_double

_SNIPPET = (
    lanes_double(2)
    + r"""
    const int* node = &cell_nodes.data[cell * 3];
    #define PW_DOT(u, w) ((u)[0] * (w)[0] + (u)[1] * (w)[1] + (u)[2] * (w)[2])
    #define PW_CROSS(out, u, w) V out[3] = {(u)[1] * (w)[2] - (u)[2] * (w)[1], \
        (u)[2] * (w)[0] - (u)[0] * (w)[2], (u)[0] * (w)[1] - (u)[1] * (w)[0]}
    for (int q = 0; q < 2; q += LANES) {
        V t[3] = {V{}, V{}, V{}}, c[3] = {V{}, V{}, V{}};
        for (int a = 0; a < 3; ++a) {
            const V g = *(const V*)&derivatives.data[(2 * a) * 2 + q];
            const V h = *(const V*)&derivatives.data[(2 * a + 1) * 2 + q];
            for (int i = 0; i < 3; ++i) {
                t[i] += x.data[3 * node[a] + i] * g;
                c[i] += x.data[3 * node[a] + i] * h;
            }
        }
        const V a2 = PW_DOT(t, t) + 1e-24;
        const V length = PW_SQRT(a2);
        const V inv_a2 = 1.0 / a2;
        const V inv_a6 = inv_a2 * inv_a2 * inv_a2;
        const V EA = *(const V*)&stretching.data[cell * 2 + q];
        const V B = *(const V*)&bending.data[cell * 2 + q];
        PW_CROSS(w, t, c);
        PW_CROSS(wt, w, t);
        PW_CROSS(cw, c, w);
        const V turn = 3.0 * PW_DOT(w, w) * inv_a2;
        const V strain = length - 1.0;
        V St[3], Sc[3];
        for (int i = 0; i < 3; ++i) {
            Sc[i] = B * inv_a6 * wt[i];
            St[i] = B * inv_a6 * (cw[i] - turn * t[i]);
        }
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
            PW_CROSS(spin, t, td);
            for (int i = 0; i < 3; ++i) spin[i] = spin[i] * inv_a2;
            PW_CROSS(carried, spin, c);
            V co[3] = {cd[0] - carried[0], cd[1] - carried[1], cd[2] - carried[2]};
            const V along = PW_DOT(t, co) * inv_a2;
            V g[3];
            for (int i = 0; i < 3; ++i) g[i] = B * tau * inv_a2 * inv_a2 * (co[i] - along * t[i]);
            PW_CROSS(z, c, g);
            PW_CROSS(zt, z, t);
            for (int i = 0; i < 3; ++i) {
                Sc[i] += g[i];
                St[i] -= zt[i] * inv_a2;
            }
        }
        for (int i = 0; i < 3; ++i) St[i] += EA * strain * t[i] / length;
        for (int a = 0; a < 3; ++a) {
            const V g = *(const V*)&derivatives.data[(2 * a) * 2 + q];
            const V h = *(const V*)&derivatives.data[(2 * a + 1) * 2 + q];
            for (int i = 0; i < 3; ++i) PW_ADD(force.data[3 * node[a] + i], -PW_SUM(St[i] * g + Sc[i] * h));
        }
    }
"""
)


@wp.func_native(_SNIPPET)
def rod_cell(
    cell: int,
    # model
    cell_nodes: wp.array(dtype=wp.int32),
    derivatives: wp.array(dtype=wp.float64),
    stretching: wp.array(dtype=wp.float64),
    bending: wp.array(dtype=wp.float64),
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
def rod_forces(
    # model
    cell_nodes: wp.array(dtype=wp.int32),
    derivatives: wp.array(dtype=wp.float64),
    stretching: wp.array(dtype=wp.float64),
    bending: wp.array(dtype=wp.float64),
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
    """Add the internal forces [N] of one cell to its 3 nodes; ``clock[1]`` is 1/dt [1/s]."""
    rod_cell(
        wp.tid(), cell_nodes, derivatives, stretching, bending, tau, viscous, clock[1], x, previous, force
    )
