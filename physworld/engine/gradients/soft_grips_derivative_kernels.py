"""Device side of soft grips differentiated: one substep's springs taken back.

The springs are implicit. With f the forces of everything else, K their stiffness, P the pull of
:class:`physworld.engine.terms.soft_grips.BoundSoftGrips`, and y the path after the substep,

    f' = f - P gap = f - K r        r = x + dt v + dt^2 (f' / m + g - c v) - y

Backwards, with w the derivatives by f', q = P w and w' = w - dt^2 q / m those by f:

    fbar = w'        gapbar = -q        along dK: -w' . dK r

Legend: gap is laid out in rows of ``width`` numbers, one for each axis; clock, counter as in
:mod:`physworld.engine.total.node_kernels`; nodes, mass, paths, gravity and drag as the term has them.
"""

from __future__ import annotations

import warp as wp

from physworld.engine.total.node_kernels import hermite


@wp.kernel(enable_backward=False)
def gather_nodes(
    # model
    nodes: wp.array[wp.int32],
    width: int,
    # in
    values: wp.array[wp.float64],
    # out
    gap: wp.array[wp.float64],
) -> None:
    """Lay the vectors of the held nodes out as gaps are."""
    held = wp.tid()
    for i in range(3):
        gap[i * width + held] = values[3 * nodes[held] + i]


@wp.kernel(enable_backward=False)
def take_grips_back(
    # model
    nodes: wp.array[wp.int32],
    mass: wp.array[wp.float64],
    drag: wp.float64,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in
    v: wp.array[wp.float64],
    pull: wp.array[wp.float64],
    # in, out
    minus_q: wp.array[wp.float64],
    force_bar: wp.array[wp.float64],
    x_bar: wp.array[wp.float64],
    v_bar: wp.array[wp.float64],
    mass_bar: wp.array[wp.float64],
    gravity_bar: wp.array[wp.float64],
    drag_bar: wp.array[wp.float64],
    path_x_bar: wp.array2d[wp.float64],
    path_v_bar: wp.array2d[wp.float64],
) -> None:
    """One held node; ``pull`` is f' / m [m/s^2], ``minus_q`` (3k,) is read and cleared."""
    held = wp.tid()
    node = nodes[held]
    dt = clock[2]
    frame = counter[0]
    s = wp.float64(counter[1] + 1) / wp.float64(counter[2])
    h = hermite(s)
    for i in range(3):
        k = 3 * node + i
        p = 3 * held + i
        q = -minus_q[p]
        minus_q[p] = wp.float64(0.0)
        late = dt * dt * q
        force_bar[k] -= late / mass[held]
        mass_bar[node] += late * pull[k] / mass[held]
        gravity_bar[k] -= late
        drag_bar[node] += late * v[k]
        x_bar[k] -= q
        v_bar[k] -= dt * (wp.float64(1.0) - dt * drag) * q
        path_x_bar[frame, p] += (wp.float64(1.0) - h[0]) * q
        path_x_bar[frame + 1, p] += h[0] * q
        path_v_bar[frame, p] += clock[0] * h[1] * q
        path_v_bar[frame + 1, p] += clock[0] * h[2] * q
