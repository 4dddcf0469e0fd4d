"""Device side of the grid of updated Lagrangian MPM: forces on nodes, grips; gripped particles.

    v_i = p_i / m_i + dt (g - c v_i)      then grips prescribe; contacts follow
    (:mod:`physworld.engine.updated.contact`)

A node belongs to a grip where at least an eighth of its mass is gripped: half a cell beyond the grip's face it has a
sixth, so a clamp on a cell face prescribes the nodes that it does in the total Lagrangian form.

Legend: clock = (frame interval [s], 1/dt [1/s], dt [s]); counter = (frame, substep, substeps of this frame); box =
first cell (3), nodes (3), rim.
"""

from __future__ import annotations

import warp as wp

GRIPPED_SHARE = 0.125


@wp.kernel(enable_backward=False)
def advance_grid(
    # model
    gravity: wp.vec3f,
    drag: float,
    gripped: int,
    clock: wp.array[wp.float64],
    box: wp.array[wp.int32],
    # in, cleared
    momentum: wp.array[wp.vec4f],
    impulse: wp.array[wp.vec4f],
    grip: wp.array[wp.vec4f],
    # out
    velocity: wp.array[wp.vec4f],
    velocity_old: wp.array[wp.vec4f],
    split: int,
) -> None:
    """Velocity [m/s] of one node at the end of the substep, before contacts, and its inverse mass [1/kg].

    ``velocity_old`` is the one without forces, where ``split``. A gripped node has the inverse mass 0.
    """
    node = wp.tid()
    if node >= box[3] * box[4] * box[5]:
        return
    p = momentum[node]
    m = p[3]
    if m <= 0.0:
        return
    momentum[node] = wp.vec4f()
    dt = wp.float32(clock[2])
    before = wp.vec3f(p[0], p[1], p[2]) / m
    v = before
    if split != 0:
        f = impulse[node]
        v += wp.vec3f(f[0], f[1], f[2]) / m
        impulse[node] = wp.vec4f()
        velocity_old[node] = wp.vec4f(before[0], before[1], before[2], m)
    v += dt * (gravity - drag * before)
    mobility = 1.0 / m
    if gripped != 0:
        h = grip[node]
        if h[3] > 0.0:
            grip[node] = wp.vec4f()
            if h[3] >= GRIPPED_SHARE * m:
                v = wp.vec3f(h[0], h[1], h[2]) / h[3]
                mobility = 0.0
    velocity[node] = wp.vec4f(v[0], v[1], v[2], mobility)


@wp.kernel(enable_backward=False)
def scatter_grips(
    # model
    particle: wp.array[wp.int32],
    mass: wp.array[wp.float32],
    path_x: wp.array2d[wp.vec3d],
    path_v: wp.array2d[wp.vec3d],
    path_gradient: wp.array2d[wp.mat33f],
    origin: wp.vec3d,
    inv_dx: wp.vec3d,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    box: wp.array[wp.int32],
    # in
    x: wp.array[wp.float64],
    # out
    goal: wp.array[wp.vec3d],
    grip: wp.array[wp.vec4f],
    flags: wp.array[wp.int32],
) -> None:
    """Place of one gripped particle after the substep, and its rigid velocity field on the 27 nodes, mass-weighted."""
    g = wp.tid()
    p = particle[g]
    frame = counter[0]
    s = wp.float64(counter[1] + 1) / wp.float64(counter[2])
    s2 = s * s
    s3 = s2 * s
    h01 = wp.float64(3.0) * s2 - wp.float64(2.0) * s3
    h10 = s3 - wp.float64(2.0) * s2 + s
    h11 = s3 - s2
    start = path_x[frame, g]
    to = start + h01 * (path_x[frame + 1, g] - start)
    to += clock[0] * (h10 * path_v[frame, g] + h11 * path_v[frame + 1, g])
    goal[g] = to
    now = wp.vec3d(x[3 * p], x[3 * p + 1], x[3 * p + 2])
    u = (to - now) * clock[1]
    share = wp.float32(s)
    L = (1.0 - share) * path_gradient[frame, g] + share * path_gradient[frame + 1, g]
    scaled = wp.cw_mul(now - origin, inv_dx)
    cell = wp.vec3d(wp.floor(scaled[0]), wp.floor(scaled[1]), wp.floor(scaled[2]))
    t = scaled - cell
    i0 = int(cell[0]) - 1 - box[0]
    j0 = int(cell[1]) - 1 - box[1]
    k0 = int(cell[2]) - 1 - box[2]
    if i0 < 0 or j0 < 0 or k0 < 0 or i0 + 2 >= box[3] or j0 + 2 >= box[4] or k0 + 2 >= box[5]:
        flags[1] = 1
        return
    weights = wp.mat33f()
    away = wp.mat33f()
    for axis in range(3):
        r = wp.float32(t[axis])
        weights[axis, 0] = 0.5 * (1.0 - r) * (1.0 - r)
        weights[axis, 1] = 0.5 + r - r * r
        weights[axis, 2] = 0.5 * r * r
        for a in range(3):
            away[axis, a] = (wp.float32(a) - 0.5 - r) / wp.float32(inv_dx[axis])
    first = wp.vec3f(wp.float32(u[0]), wp.float32(u[1]), wp.float32(u[2]))
    for a in range(3):
        for b in range(3):
            for c in range(3):
                weight = mass[p] * weights[0, a] * weights[1, b] * weights[2, c]
                field = first + L * wp.vec3f(away[0, a], away[1, b], away[2, c])
                node = ((i0 + a) * box[4] + j0 + b) * box[5] + k0 + c
                wp.atomic_add(grip, node, weight * wp.vec4f(field[0], field[1], field[2], 1.0))


@wp.kernel(enable_backward=False)
def place_grips(
    # model
    particle: wp.array[wp.int32],
    path_gradient: wp.array2d[wp.mat33f],
    path_v: wp.array2d[wp.vec3d],
    counter: wp.array[wp.int32],
    goal: wp.array[wp.vec3d],
    # out
    x: wp.array[wp.float64],
    v: wp.array[wp.float32],
    C: wp.array[wp.float32],
) -> None:
    """Put one gripped particle where its grip carries it."""
    g = wp.tid()
    p = particle[g]
    frame = counter[0]
    share = wp.float32(counter[1] + 1) / wp.float32(counter[2])
    L = (1.0 - share) * path_gradient[frame, g] + share * path_gradient[frame + 1, g]
    u = (wp.float64(1.0) - wp.float64(share)) * path_v[frame, g] + wp.float64(share) * path_v[frame + 1, g]
    for i in range(3):
        x[3 * p + i] = goal[g][i]
        v[3 * p + i] = wp.float32(u[i])
        for j in range(3):
            C[9 * p + 3 * i + j] = L[i, j]
