"""Device side of a sheet of triangles: membrane forces of linear triangles, bending forces of their inner edges.

See :mod:`physworld.mpm.triangles` for the energies. Internal friction is of Kelvin-Voigt kind: a strain e is replaced
by e + tau de/dt; that of an edge is its bending along its own normal, so a sheet that turns as a whole does not rub.
"""

from __future__ import annotations

import warp as wp


@wp.func
def _node(x: wp.array(dtype=wp.float64), k: int):
    return wp.vec3d(x[3 * k], x[3 * k + 1], x[3 * k + 2])


@wp.func
def _add(force: wp.array(dtype=wp.float64), k: int, f: wp.vec3d):
    wp.atomic_add(force, 3 * k, f[0])
    wp.atomic_add(force, 3 * k + 1, f[1])
    wp.atomic_add(force, 3 * k + 2, f[2])


@wp.kernel(enable_backward=False)
def triangle_forces(
    # model
    corners: wp.array2d(dtype=wp.int32),
    slopes: wp.array2d(dtype=wp.float64),
    membrane: wp.array(dtype=wp.float64),
    shape: wp.array(dtype=wp.float64),
    edges: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.float64),
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
    """Add the internal forces [N] of a triangle, or of an edge after the last triangle; ``clock[1]`` is 1/dt [1/s]."""
    number = wp.tid()
    triangles = corners.shape[0]
    if number < triangles:
        a1 = wp.vec3d()
        a2 = wp.vec3d()
        for k in range(3):
            place = _node(x, corners[number, k])
            a1 += slopes[number, 2 * k] * place
            a2 += slopes[number, 2 * k + 1] * place
        half = wp.float64(0.5)
        e = wp.vec3d(
            half * (wp.dot(a1, a1) - wp.float64(1.0)),
            half * (wp.dot(a2, a2) - wp.float64(1.0)),
            half * wp.dot(a1, a2),
        )
        if viscous != 0:
            now = e
            for i in range(3):
                e[i] = now[i] + (now[i] - previous[3 * number + i]) * tau * clock[1]
                previous[3 * number + i] = now[i]
        stiffness = membrane[number]
        n11 = stiffness * (shape[0] * e[0] + shape[2] * e[1])
        n22 = stiffness * (shape[2] * e[0] + shape[1] * e[1])
        n12 = stiffness * shape[3] * e[2]
        first = n11 * a1 + n12 * a2
        second = n12 * a1 + n22 * a2
        for k in range(3):
            _add(
                force,
                corners[number, k],
                -(slopes[number, 2 * k] * first + slopes[number, 2 * k + 1] * second),
            )
    else:
        edge = number - triangles
        bent = wp.vec3d()
        for k in range(4):
            bent += weights[edge, k] * _node(x, edges[edge, k])
        if viscous != 0:
            start = _node(x, edges[edge, 0])
            along = _node(x, edges[edge, 1]) - start
            normal = wp.cross(along, _node(x, edges[edge, 2]) - start) - wp.cross(
                along, _node(x, edges[edge, 3]) - start
            )
            normal = wp.normalize(normal)
            curved = wp.dot(bent, normal)
            bent += (curved - previous[3 * number]) * tau * clock[1] * normal
            previous[3 * number] = curved
        load = bending[edge] * bent
        for k in range(4):
            _add(force, edges[edge, k], -weights[edge, k] * load)
