"""Device side of the energy ledger: work of every kind of force on every node, summed substep by substep.

Works are taken by the trapezoidal rule along the path of a node, (f_n + f_(n+1))/2 . (x_(n+1) - x_n): the sum that a
symplectic step conserves to second order in dt. The velocity of a step is the node's displacement over dt.

Legend: column of a sum: 0 elastic, 1 internal (elastic and internal friction), 2 all forces, 3 twist, 4 drag.
"""

from __future__ import annotations

import warp as wp


@wp.kernel
def keep_forces(
    # in
    force: wp.array[wp.float64],
    # out
    kept: wp.array[wp.float64],
) -> None:
    """Copy the forces that have been added so far."""
    i = wp.tid()
    kept[i] = force[i]


@wp.kernel
def sum_works(
    # model
    mass: wp.array[wp.float64],
    gravity: wp.vec3d,
    drag: wp.float64,
    lag: wp.float64,
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    internal: wp.array[wp.float64],
    total: wp.array[wp.float64],
    # in, out
    elastic: wp.array[wp.float64],
    twist: wp.array[wp.float64],
    last_x: wp.array[wp.float64],
    last_force: wp.array2d[wp.float64],
    last_dt: wp.array[wp.float64],
    work: wp.array2d[wp.float64],
    # out
    work_out: wp.array3d[wp.float64],
    v_out: wp.array2d[wp.float64],
) -> None:
    """Add the works of the last substep at one node; at a frame, write them and the velocity at that very time.

    ``lag``: steps by which velocities are behind positions at the start of a run.
    """
    node = wp.tid()
    first = counter[0] == 0 and counter[1] == 0
    frame = counter[1] == 0
    # velocities lag by half a step of the old length later
    half = wp.float64(0.5) * last_dt[node]
    if first:
        half = lag * clock[2]
        for column in range(5):
            work[column, node] = wp.float64(0.0)
    for axis in range(3):
        i = 3 * node + axis
        moved = x[i] - last_x[i]
        if first:
            moved = wp.float64(0.0)
        works = wp.vec4d(elastic[i], internal[i], total[i], twist[i])
        for column in range(4):
            work[column, node] += wp.float64(0.5) * (works[column] + last_force[column, i]) * moved
            last_force[column, i] = works[column]
        work[4, node] += mass[node] * drag * v[i] * moved
        if frame:
            v_out[counter[0], i] = v[i] + half * (total[i] / mass[node] + gravity[axis] - drag * v[i])
        last_x[i] = x[i]
        elastic[i] = wp.float64(0.0)
        twist[i] = wp.float64(0.0)
    if frame:
        for column in range(5):
            work_out[counter[0], column, node] = work[column, node]
    last_dt[node] = clock[2]


@wp.kernel
def sum_friction(
    # model
    mass: wp.array[wp.float64],
    drag: wp.float64,
    # in
    x: wp.array[wp.float64],
    last_x: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    mean: wp.array[wp.float64],
    # in, out
    friction: wp.array[wp.float64],
    last_moved: wp.array[wp.float64],
    work: wp.array2d[wp.float64],
    # out
    work_out: wp.array3d[wp.float64],
) -> None:
    """Add the works of sub-cycled friction and drag at one node: those of the last step, over the moves around it.

    At a frame the half of the last step's work is still to come, as its half of the kick is in the velocity.
    """
    node = wp.tid()
    first = counter[0] == 0 and counter[1] == 0
    if first:
        work[0, node] = wp.float64(0.0)
        work[1, node] = wp.float64(0.0)
    for axis in range(3):
        i = 3 * node + axis
        moved = x[i] - last_x[i]
        if first:
            moved = wp.float64(0.0)
            last_moved[i] = wp.float64(0.0)
        else:
            way = wp.float64(0.5) * (last_moved[i] + moved)
            work[0, node] += friction[i] * way
            work[1, node] -= mass[node] * drag * mean[i] * way
        last_moved[i] = moved
        friction[i] = wp.float64(0.0)
    if counter[1] == 0:
        work_out[counter[0], 0, node] = work[0, node]
        work_out[counter[0], 1, node] = work[1, node]
