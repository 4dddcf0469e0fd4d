"""Device side of the nodes: symplectic time step, prescribed motion.

Nodes that gripped material touches follow a cubic Hermite path between the frames of the control track; all others
obey m dv/dt = f + m g - m c v.

Legend: clock = (frame interval [s], 1/dt [1/s], dt [s]); counter = (frame, substep, substeps of this frame).
"""

from __future__ import annotations

import warp as wp


@wp.func
def weighted_sum(
    values: wp.array[wp.float64],
    nodes: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    first: int,
    last: int,
) -> wp.vec3d:
    """Sum of weights times the vectors of nodes, entries ``first`` to ``last``.

    A function of its own since Warp's adjoint kernels do not run a loop of unknown length again for what follows it.
    """
    total = wp.vec3d()
    for k in range(first, last):
        node = 3 * nodes[k]
        total += weights[k] * wp.vec3d(values[node], values[node + 1], values[node + 2])
    return total


@wp.func
def hermite(s: wp.float64) -> wp.vec3d:
    """Weights of the second place and of the two velocities times the interval, at the share ``s`` of it."""
    s2 = s * s
    s3 = s2 * s
    return wp.vec3d(wp.float64(3.0) * s2 - wp.float64(2.0) * s3, s3 - wp.float64(2.0) * s2 + s, s3 - s2)


@wp.func
def on_path(
    path_x: wp.array2d[wp.float64], path_v: wp.array2d[wp.float64], frame: int, k: int,
    s: wp.float64, span: wp.float64,
) -> wp.float64:  # fmt: skip
    """Cubic Hermite between two frames at the share ``s`` of their interval ``span`` [s]."""
    h = hermite(s)
    start = path_x[frame, k]
    goal = start + h[0] * (path_x[frame + 1, k] - start)
    return goal + span * (h[1] * path_v[frame, k] + h[2] * path_v[frame + 1, k])


@wp.func
def advance(
    node: int,
    mass: wp.array[wp.float64],
    slot: wp.array[wp.int32],
    path_x: wp.array2d[wp.float64],
    path_v: wp.array2d[wp.float64],
    gravity: wp.vec3d,
    drag: wp.float64,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    force: wp.array[wp.float64],
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
) -> None:
    """One symplectic Euler step of a node; its force is read and cleared."""
    dt = clock[2]
    held = slot[node]
    if held >= 0:
        s = wp.float64(counter[1] + 1) / wp.float64(counter[2])
        for i in range(3):
            goal = on_path(path_x, path_v, counter[0], 3 * held + i, s, clock[0])
            v[3 * node + i] = (goal - x[3 * node + i]) / dt
            x[3 * node + i] = goal
            force[3 * node + i] = wp.float64(0.0)
    else:
        for i in range(3):
            k = 3 * node + i
            speed = v[k] + dt * (force[k] / mass[node] + gravity[i] - drag * v[k])
            v[k] = speed
            x[k] = x[k] + dt * speed
            force[k] = wp.float64(0.0)


@wp.kernel
def advance_nodes(
    # model
    mass: wp.array[wp.float64],
    slot: wp.array[wp.int32],
    path_x: wp.array2d[wp.float64],
    path_v: wp.array2d[wp.float64],
    gravity: wp.vec3d,
    drag: wp.float64,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in, out
    force: wp.array[wp.float64],
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
) -> None:
    """One step of a node of one body."""
    advance(wp.tid(), mass, slot, path_x, path_v, gravity, drag, clock, counter, force, x, v)


@wp.kernel
def advance_nodes_side_by_side(
    # model
    mass: wp.array[wp.float64],
    slot: wp.array[wp.int32],
    path_x: wp.array2d[wp.float64],
    path_v: wp.array2d[wp.float64],
    gravity: wp.array[wp.vec3d],
    drag: wp.array[wp.float64],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    nodes: int,
    # in, out
    force: wp.array[wp.float64],
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
) -> None:
    """One step of a node of bodies with ``nodes`` nodes each, whose gravity and drag may differ."""
    node = wp.tid()
    body = node // nodes
    advance(node, mass, slot, path_x, path_v, gravity[body], drag[body], clock, counter, force, x, v)


@wp.kernel
def advance_counter(counter: wp.array[wp.int32]) -> None:
    """Next substep."""
    counter[1] = counter[1] + 1
