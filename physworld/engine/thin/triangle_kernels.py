"""Device side of a sheet of triangles: membrane forces of linear triangles, bending forces of their inner edges.

See :mod:`physworld.engine.thin.triangles` for the energies. Internal friction is of Kelvin-Voigt kind: a strain e is
replaced by e + tau de/dt; that of an edge is its bending along its own normal, so a sheet that turns as a whole does
not rub.
"""

from __future__ import annotations

import warp as wp

from physworld.engine.lattice.lanes import lanes_double

_TRIANGLE = (
    lanes_double(1)
    + r"""
    const int* node = &corners.data[3 * number];
    const double* g = &slopes.data[6 * number];
    double a[2][3] = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < 3; ++i) {
            const double place = x.data[3 * node[k] + i];
            a[0][i] += g[2 * k] * place;
            a[1][i] += g[2 * k + 1] * place;
        }
    double e[3] = {-0.5, -0.5, 0.0};
    for (int i = 0; i < 3; ++i) {
        e[0] += 0.5 * a[0][i] * a[0][i];
        e[1] += 0.5 * a[1][i] * a[1][i];
        e[2] += 0.5 * a[0][i] * a[1][i];
    }
    if (viscous) {
        double* row = &previous.data[3 * number];
        for (int i = 0; i < 3; ++i) {
            const double now = e[i];
            e[i] = now + (now - row[i]) * (tau * inv_dt);
            row[i] = now;
        }
    }
    const double K = membrane.data[number];
    const double* C = shape.data;
    const double n11 = K * (C[0] * e[0] + C[2] * e[1]), n22 = K * (C[2] * e[0] + C[1] * e[1]), n12 = K * C[3] * e[2];
    for (int i = 0; i < 3; ++i) {
        const double first = n11 * a[0][i] + n12 * a[1][i], second = n12 * a[0][i] + n22 * a[1][i];
        for (int k = 0; k < 3; ++k)
            PW_ADD(force.data[3 * node[k] + i], -(g[2 * k] * first + g[2 * k + 1] * second));
    }
"""
)

_EDGE = (
    lanes_double(1)
    + r"""
    const int* node = &edges.data[4 * number];
    const double* c = &weights.data[4 * number];
    double bent[3] = {0.0, 0.0, 0.0};
    for (int k = 0; k < 4; ++k)
        for (int i = 0; i < 3; ++i) bent[i] += c[k] * x.data[3 * node[k] + i];
    if (viscous) {
        double d[3][3];   // from the first end: along the edge, and between the corners across it
        for (int i = 0; i < 3; ++i) {
            const double start = x.data[3 * node[0] + i];
            d[0][i] = x.data[3 * node[1] + i] - start;
            d[1][i] = x.data[3 * node[2] + i] - x.data[3 * node[3] + i];
        }
        double n[3] = {d[0][1] * d[1][2] - d[0][2] * d[1][1], d[0][2] * d[1][0] - d[0][0] * d[1][2],
                       d[0][0] * d[1][1] - d[0][1] * d[1][0]};
        const double size = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]) + 1e-24;
        double curved = 0.0;
        for (int i = 0; i < 3; ++i) {
            n[i] /= size;
            curved += bent[i] * n[i];
        }
        double* row = &previous.data[3 * (number + triangles)];
        for (int i = 0; i < 3; ++i) bent[i] += (curved - *row) * (tau * inv_dt) * n[i];
        *row = curved;
    }
    const double D = bending.data[number];
    for (int k = 0; k < 4; ++k)
        for (int i = 0; i < 3; ++i) PW_ADD(force.data[3 * node[k] + i], -D * c[k] * bent[i]);
"""
)


@wp.func_native(_TRIANGLE)
def triangle(
    number: int,
    corners: wp.array[wp.int32],
    slopes: wp.array[wp.float64],
    membrane: wp.array[wp.float64],
    shape: wp.array[wp.float64],
    tau: wp.float64,
    viscous: int,
    inv_dt: wp.float64,
    x: wp.array[wp.float64],
    previous: wp.array[wp.float64],
    force: wp.array[wp.float64],
) -> None: ...


@wp.func_native(_EDGE)
def edge(
    number: int,
    triangles: int,
    edges: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    bending: wp.array[wp.float64],
    tau: wp.float64,
    viscous: int,
    inv_dt: wp.float64,
    x: wp.array[wp.float64],
    previous: wp.array[wp.float64],
    force: wp.array[wp.float64],
) -> None: ...


@wp.kernel(enable_backward=False)
def triangle_forces(
    # model
    triangles: int,
    corners: wp.array[wp.int32],
    slopes: wp.array[wp.float64],
    membrane: wp.array[wp.float64],
    shape: wp.array[wp.float64],
    edges: wp.array[wp.int32],
    weights: wp.array[wp.float64],
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
    """Add the internal forces [N] of a triangle, or of an edge after the last triangle; ``clock[1]`` is 1/dt [1/s]."""
    number = wp.tid()
    if number < triangles:
        triangle(number, corners, slopes, membrane, shape, tau, viscous, clock[1], x, previous, force)
    else:
        edge(
            number - triangles, triangles, edges, weights, bending, tau, viscous, clock[1], x, previous, force
        )
