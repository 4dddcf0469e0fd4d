"""Device side of forward sensitivities: the tangent of one substep of the nodes.

With d for derivatives by a scalar, f the forces and goal the prescribed path:

    free    dv' = dv + dt ((df - f dm / m) / m + dg - dc v - c dv)      dx' = dx + dt dv'
    held    dx' = dgoal,  dv' = (dgoal - dx) / dt

Legend: clock, counter as in :mod:`physworld.engine.total.node_kernels`.
"""

from __future__ import annotations

import warp as wp

from physworld.engine.total.node_kernels import on_path


@wp.kernel(enable_backward=False)
def set_sides(
    # in
    half_width: wp.float64,
    centre: wp.array[wp.float64],
    tangent: wp.array[wp.float64],
    # out
    high: wp.array[wp.float64],
    low: wp.array[wp.float64],
) -> None:
    """One component of centre +- half_width tangent."""
    k = wp.tid()
    step = half_width * tangent[k]
    high[k] = centre[k] + step
    low[k] = centre[k] - step


@wp.kernel(enable_backward=False)
def add_slope(
    # in
    width: wp.float64,
    # in, out
    high: wp.array[wp.float64],
    low: wp.array[wp.float64],
    slope: wp.array[wp.float64],
) -> None:
    """Add (high - low) / width; both are cleared."""
    k = wp.tid()
    slope[k] += (high[k] - low[k]) / width
    high[k] = wp.float64(0.0)
    low[k] = wp.float64(0.0)


@wp.kernel(enable_backward=False)
def advance_tangent(
    # model
    mass: wp.array[wp.float64],
    mass_slope: wp.array[wp.float64],
    slot: wp.array[wp.int32],
    path_x_slope: wp.array2d[wp.float64],
    path_v_slope: wp.array2d[wp.float64],
    gravity_slope: wp.vec3d,
    drag: wp.float64,
    drag_slope: wp.float64,
    starting: int,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in
    force: wp.array[wp.float64],
    v: wp.array[wp.float64],
    # in, out
    force_slope: wp.array[wp.float64],
    dx: wp.array[wp.float64],
    dv: wp.array[wp.float64],
    dx_previous: wp.array[wp.float64],
) -> None:
    """One node; ``starting``: the half step back at the start, velocities only."""
    node = wp.tid()
    dt = clock[2]
    if starting == 1:
        dt = wp.float64(-0.5) * dt
    held = slot[node]
    for i in range(3):
        k = 3 * node + i
        dx_previous[k] = dx[k]
        if held < 0 or starting == 1:
            pull = (force_slope[k] - force[k] * mass_slope[node] / mass[node]) / mass[node]
            dv[k] = dv[k] + dt * (pull + gravity_slope[i] - drag_slope * v[k] - drag * dv[k])
            if starting == 0:
                dx[k] = dx[k] + dt * dv[k]
        force_slope[k] = wp.float64(0.0)
    if held >= 0 and starting == 0:
        s = wp.float64(counter[1] + 1) / wp.float64(counter[2])
        for i in range(3):
            k = 3 * node + i
            goal = on_path(path_x_slope, path_v_slope, counter[0], 3 * held + i, s, clock[0])
            dv[k] = (goal - dx[k]) / dt
            dx[k] = goal
