"""Device side of ground whose friction differs from point to point: a plane that stays, normal along z.

The law is that of :mod:`physworld.engine.terms.colliders_kernels` with one coefficient for every contact point.

Legend: clock = (frame interval [s], 1/dt [1/s], dt [s]); counter = (frame, substep, substeps of this frame);
totals = (impulse on the body [N s] (3), greatest depth [m]).
"""

from __future__ import annotations

import warp as wp

from physworld.engine.terms.colliders_kernels import ROUND_OFF_M
from physworld.engine.total.node_kernels import weighted_sum


@wp.kernel
def touch_ground(
    # model: contact points
    row_start: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    measure: wp.array[wp.float64],
    offset: wp.array[wp.float64],
    # model: normal and tangential stiffness [N/m per measure], dampings [N s/m per measure]
    stiffness: wp.float64,
    shear_stiffness: wp.float64,
    damping: wp.float64,
    shear_damping: wp.float64,
    # model: Coulomb's coefficient of every point, height [m]
    friction: wp.array[wp.float64],
    height: wp.float64,
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    travel: wp.array[wp.float64],
    # in, out
    clearance: wp.array[wp.float64],
    stretch: wp.array[wp.vec3d],
    # out
    force: wp.array[wp.float64],
    totals: wp.array[wp.float64],
) -> None:
    """Push one point of the body off the ground, and hold it along the ground up to its own limit."""
    point = wp.tid()
    zero = wp.float64(0.0)
    left = clearance[point] - travel[counter[1] % 2]
    if counter[0] == 0 and counter[1] == 0:  # whatever a run before left, even one that blew up
        left = zero
    clearance[point] = left
    if left > wp.static(wp.float64(ROUND_OFF_M)):
        return
    here = weighted_sum(x, columns, weights, row_start[point], row_start[point + 1])
    depth = offset[point] - (here[2] - height)
    clearance[point] = -depth
    if depth <= zero:
        stretch[point] = wp.vec3d()
        return
    speed = weighted_sum(v, columns, weights, row_start[point], row_start[point + 1])
    slide = wp.vec3d(speed[0], speed[1], zero)
    pressure = wp.max(stiffness * depth - damping * speed[2], zero) * measure[point]
    slip = wp.vec3d()
    if counter[0] > 0 or counter[1] > 0:
        slip = stretch[point]
    slip += clock[2] * slide
    drag = measure[point] * (shear_stiffness * slip + shear_damping * slide)
    size_of_drag = wp.length(drag)
    limit = friction[point] * pressure
    if size_of_drag > limit:
        drag *= limit / size_of_drag
        longest = limit / (measure[point] * shear_stiffness)
        length = wp.length(slip)
        if length > longest:
            slip *= longest / length
    stretch[point] = slip
    push = wp.vec3d(-drag[0], -drag[1], pressure)
    for k in range(row_start[point], row_start[point + 1]):
        node = 3 * columns[k]
        for i in range(3):
            wp.atomic_add(force, node + i, weights[k] * push[i])
    for i in range(3):
        wp.atomic_add(totals, i, clock[2] * push[i])
    wp.atomic_max(totals, 3, depth)
