"""Device side of sheets and rods differentiated: products of a direction w with the derivatives of the forces.

What one cell adds, with e the strains (and curvatures), de their derivative along w and N the stresses times area:

    out           = d(w.f)/dx
    out_previous  = d(w.f)/dx_previous            friction only
    parameter_out = three columns: stretch and bending stiffness, and the friction's time tau

Sheet: f = -de/dx N(e + tau (e - e_previous) / dt), the derivative by dual numbers; N is linear, so e_previous enters by
the stresses of -tau/dt de at the strains of x_previous. Rod: the elastic part by dual numbers; the friction's phi =
-w.f_v = B tau / |t|^4 c_w . c_rate (c the corotational rates of bending across t) is linear and symmetric in w and the
rate, and its derivative by the shape takes a dual number in each of the six directions of (t, c).

The pieces of text are those of :mod:`physworld.engine.thin.sheet_kernels` and :mod:`physworld.engine.thin.rod_kernels`.
"""

from __future__ import annotations

import warp as wp

from physworld.engine.lattice.lanes import lanes_double
from physworld.engine.thin import rod_kernels as rod
from physworld.engine.thin import sheet_kernels as sheet

_ADD_PARAMETERS = r"""
        if (wanted)
            for (int k = 0; k < LANES; ++k)
                for (int m = 0; m < 3; ++m)
                    parameter_out.data[(cell * PARTICLES + q + k) * 3 + m] -= ((const double*)&work[m])[k];
"""

_SHEET = (
    lanes_double(4)
    + r"""
    const int* node = &cell_nodes.data[cell * 9];
    const double lag = viscous ? tau * inv_dt : 0.0;
    for (int q = 0; q < 4; q += LANES) {
        typedef D S;
        V now[5][3], along[5][3];
"""
    + sheet.load("x", "now")
    + sheet.load("w", "along")
    + "        D d[5][3];\n        for (int k = 0; k < 5; ++k)\n"
    + "            for (int i = 0; i < 3; ++i) d[k][i] = D{now[k][i], along[k][i]};\n"
    + sheet.SURFACE
    + sheet.MODULI
    + r"""
        V change[6], late[6];
        for (int k = 0; k < 6; ++k) {
            change[k] = strain[k].b;
            late[k] = V{};
        }
        if (viscous) {
            D* const present = strain;
            typedef V S;
            V d[5][3];
"""
    + sheet.load("x_previous", "d")
    + sheet.SURFACE
    + r"""
            for (int k = 0; k < 6; ++k) late[k] = (present[k].a - strain[k]) * lag;
            V N[6];
            PW_RESULTANTS(N, change)
            for (int k = 0; k < 6; ++k) N[k] = N[k] * lag;
"""
    + sheet.LOADS
    + sheet.scatter("out_previous", "+")
    + r"""
        }
        V friction[6], work[3];
        PW_RESULTANTS(friction, late)
        for (int k = 0; k < 6; ++k) strain[k] = D{strain[k].a + late[k], strain[k].b * (1.0 + lag)};
        D N[6];
        PW_RESULTANTS(N, strain)
        work[0] = N[0].a * change[0] + N[1].a * change[1] + 2.0 * N[2].a * change[2];
        work[1] = N[3].a * change[3] + N[4].a * change[4] + 2.0 * N[5].a * change[5];
        work[2] = friction[0] * change[0] + friction[1] * change[1] + 2.0 * friction[2] * change[2]
            + friction[3] * change[3] + friction[4] * change[4] + 2.0 * friction[5] * change[5];
"""
    + sheet.LOADS
    + sheet.scatter("out", member=".b")
    + _ADD_PARAMETERS.replace("PARTICLES", "4")
    + "    }\n"
)

_ROD = (
    lanes_double(2)
    + r"""
    const int* node = &cell_nodes.data[cell * 3];
    for (int q = 0; q < 2; q += LANES) {
        V tv[3], cv[3], tw[3], cw_[3], work[3] = {V{}, V{}, V{}};
"""
    + rod.load("x", "tv", "cv")
    + rod.load("w", "tw", "cw_")
    + rod.MODULI
    + r"""
        V Tt[3], Tc[3];
        {
            typedef D S;
            D t[3], c[3];
            for (int i = 0; i < 3; ++i) {
                t[i] = D{tv[i], tw[i]};
                c[i] = D{cv[i], cw_[i]};
            }
"""
    + rod.ELASTIC
    + r"""
            for (int i = 0; i < 3; ++i) {
                Tt[i] = St[i].b;
                Tc[i] = Sc[i].b;
                const V stretch = pull.a * tv[i] * tw[i];
                work[0] = work[0] + stretch;
                work[1] = work[1] + St[i].a * tw[i] - stretch + Sc[i].a * cw_[i];
            }
        }
        if (viscous) {
            V told[3], cold[3], td[3], cd[3];
"""
    + rod.load("x_previous", "told", "cold")
    + r"""
            for (int i = 0; i < 3; ++i) {
                td[i] = (tv[i] - told[i]) * inv_dt;
                cd[i] = (cv[i] - cold[i]) * inv_dt;
            }
            for (int k = 0; k < 6; ++k) {
                typedef D S;
                D t[3], c[3];
                for (int i = 0; i < 3; ++i) {
                    t[i] = D{tv[i], V{} + (k == i ? 1.0 : 0.0)};
                    c[i] = D{cv[i], V{} + (k == i + 3 ? 1.0 : 0.0)};
                }
                const D inv_a2 = lane::inverse(PW_DOT(t, t) + 1e-24);
                PW_CROSS(spin, t, td);
                PW_CROSS(spin_w, t, tw);
                PW_CROSS(carried, spin, c);
                PW_CROSS(carried_w, spin_w, c);
                D co[3], co_w[3];
                for (int i = 0; i < 3; ++i) {
                    co[i] = carried[i] * inv_a2 * -1.0 + cd[i];
                    co_w[i] = carried_w[i] * inv_a2 * -1.0 + cw_[i];
                }
                const D across = PW_DOT(co, co_w) - PW_DOT(t, co) * PW_DOT(t, co_w) * inv_a2;
                const D phi = across * inv_a2 * inv_a2 * (B * tau);
                if (k < 3) Tt[k] = Tt[k] + phi.b; else Tc[k - 3] = Tc[k - 3] + phi.b;
                if (k == 0) work[2] = phi.a;
            }
            work[1] = work[1] + work[2];
            {
                typedef V S;
                const V *t = tv, *c = cv, *td = tw, *cd = cw_;
                const V inv_a2 = 1.0 / (PW_DOT(t, t) + 1e-24);
"""
    + rod.FRICTION
    + r"""
                for (int i = 0; i < 3; ++i) {
                    Gt[i] = Gt[i] * inv_dt;
                    Gc[i] = Gc[i] * inv_dt;
                    Tt[i] = Tt[i] + Gt[i];
                    Tc[i] = Tc[i] + Gc[i];
                }
"""
    + rod.scatter("out_previous", "Gt", "Gc", "+")
    + "            }\n        }\n"
    + rod.scatter("out", "Tt", "Tc")
    + _ADD_PARAMETERS.replace("PARTICLES", "2")
    + "    }\n"
)


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
    viscous: int,
    wanted: int,
    inv_dt: wp.float64,
    # in
    x: wp.array[wp.float64],
    x_previous: wp.array[wp.float64],
    w: wp.array[wp.float64],
    # out
    out: wp.array[wp.float64],
    out_previous: wp.array[wp.float64],
    parameter_out: wp.array[wp.float64],
) -> None: ...


@wp.kernel(enable_backward=False)
def sheet_tangent(
    # model
    cell_nodes: wp.array[wp.int32],
    derivatives: wp.array[wp.float64],
    membrane: wp.array[wp.float64],
    bending: wp.array[wp.float64],
    shape: wp.array[wp.float64],
    tau: wp.float64,
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
    """The products of one cell of a sheet; ``clock[1]`` is 1/dt [1/s]."""
    sheet_cell(
        wp.tid(), cell_nodes, derivatives, membrane, bending, shape, tau, viscous, wanted, clock[1],
        x, x_previous, w, out, out_previous, parameter_out,
    )  # fmt: skip


@wp.func_native(_ROD)
def rod_cell(
    cell: int,
    # model
    cell_nodes: wp.array[wp.int32],
    derivatives: wp.array[wp.float64],
    stretching: wp.array[wp.float64],
    bending: wp.array[wp.float64],
    tau: wp.float64,
    viscous: int,
    wanted: int,
    inv_dt: wp.float64,
    # in
    x: wp.array[wp.float64],
    x_previous: wp.array[wp.float64],
    w: wp.array[wp.float64],
    # out
    out: wp.array[wp.float64],
    out_previous: wp.array[wp.float64],
    parameter_out: wp.array[wp.float64],
) -> None: ...


@wp.kernel(enable_backward=False)
def rod_tangent(
    # model
    cell_nodes: wp.array[wp.int32],
    derivatives: wp.array[wp.float64],
    stretching: wp.array[wp.float64],
    bending: wp.array[wp.float64],
    tau: wp.float64,
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
    """The products of one cell of a rod; ``clock[1]`` is 1/dt [1/s]."""
    rod_cell(
        wp.tid(), cell_nodes, derivatives, stretching, bending, tau, viscous, wanted, clock[1],
        x, x_previous, w, out, out_previous, parameter_out,
    )  # fmt: skip
