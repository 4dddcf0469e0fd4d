"""Device side of the energy ledger of the updated Lagrangian form: works on the grid, kinetic energy of particles.

An impulse J on a node of mass m that goes from the velocity v to v' does the work J . (v + v') / 2: these works and the
change of m v^2 / 2 agree to rounding. A grip works at its own velocity, J . v'; that it also stops what free particles
brought to its nodes, J . (v' - v) / 2, is a loss of the transfer.

Legend: sums 0 stress, 1 gravity, 2 drag, 3 grips, 4 contacts, 5 loss at grips, 6 kinetic energy of the grid before and
7 after; 8 to 11 of the particles as the substep begins, as they go to the grid, as they come back, as it ends.
"""

from __future__ import annotations

import warp as wp


@wp.kernel(enable_backward=False)
def sum_grid_works(
    # model
    gravity: wp.vec3f,
    drag: float,
    clock: wp.array[wp.float64],
    box: wp.array[wp.int32],
    # in
    momentum: wp.array[wp.vec4f],
    impulse: wp.array[wp.vec4f],
    velocity: wp.array[wp.vec4f],
    # out
    sums: wp.array[wp.float64],
) -> None:
    """Add the works of one substep at one node; ``momentum`` and ``impulse`` are those before the grid advanced."""
    node = wp.tid()
    if node >= box[3] * box[4] * box[5]:
        return
    p = momentum[node]
    m = wp.float64(p[3])
    if m <= wp.float64(0.0):
        return
    dt = clock[2]
    f = impulse[node]
    u = velocity[node]
    before = wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2])) / m
    after = wp.vec3d(wp.float64(u[0]), wp.float64(u[1]), wp.float64(u[2]))
    of_stress = wp.vec3d(wp.float64(f[0]), wp.float64(f[1]), wp.float64(f[2]))
    of_gravity = m * dt * wp.vec3d(wp.float64(gravity[0]), wp.float64(gravity[1]), wp.float64(gravity[2]))
    of_drag = -m * dt * wp.float64(drag) * before
    rest = m * (after - before) - of_stress - of_gravity - of_drag
    way = wp.float64(0.5) * (before + after)
    wp.atomic_add(sums, 0, wp.dot(of_stress, way))
    wp.atomic_add(sums, 1, wp.dot(of_gravity, way))
    wp.atomic_add(sums, 2, wp.dot(of_drag, way))
    if u[3] == 0.0:
        wp.atomic_add(sums, 3, wp.dot(rest, after))
        wp.atomic_add(sums, 5, wp.dot(rest, after - way))
    else:
        wp.atomic_add(sums, 4, wp.dot(rest, way))
    wp.atomic_add(sums, 6, wp.float64(0.5) * m * wp.dot(before, before))
    wp.atomic_add(sums, 7, wp.float64(0.5) * m * wp.dot(after, after))


@wp.kernel(enable_backward=False)
def sum_kinetic(
    # model
    mass: wp.array[wp.float32],
    # in
    v: wp.array[wp.float32],
    column: int,
    # out
    sums: wp.array[wp.float64],
) -> None:
    """Add one particle's kinetic energy [J] to a column."""
    p = wp.tid()
    u = wp.vec3d(wp.float64(v[3 * p]), wp.float64(v[3 * p + 1]), wp.float64(v[3 * p + 2]))
    wp.atomic_add(sums, column, wp.float64(0.5) * wp.float64(mass[p]) * wp.dot(u, u))
