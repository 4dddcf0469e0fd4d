"""Device side of the reverse pass of a run: one substep of the nodes taken back, and what it needs to know of them.

With (x, v) before a substep, (x', v') after it, f the forces, and bars for derivatives of the result:

    free    v' = v + dt (f / m + g - c v),  x' = x + dt v'
            a = vbar' + dt xbar'            fbar = dt a / m       vbar = (1 - dt c) a    xbar = xbar' + df/dx^T fbar
    held    x' = goal,  v' = (goal - x) / dt
            goalbar = xbar' + vbar' / dt    fbar = 0              vbar = 0               xbar = -vbar' / dt

Positions are not kept but found again: x_(k-1) = x_k - dt v_k, for free and held nodes alike. Single precision is
enough for the kept velocities of a frame, whose positions are kept in double.

Legend: history rows are velocities before every substep; clock, counter as in
:mod:`physworld.engine.total.node_kernels`.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from physworld.engine.total.node_kernels import hermite


@wp.kernel(enable_backward=False)
def keep_row(
    # in
    offset: wp.array[wp.int32],
    counter: wp.array[wp.int32],
    values: wp.array[wp.float64],
    # out
    history: wp.array2d[Any],
) -> None:
    """Write one component into the row of this substep."""
    k = wp.tid()
    history[offset[counter[0]] + counter[1], k] = history.dtype(values[k])


@wp.kernel(enable_backward=False)
def keep_rows(
    # in
    offset: wp.array[wp.int32],
    counter: wp.array[wp.int32],
    memory: wp.array[Any],
    # out
    rows: wp.array2d[wp.float64],
) -> None:
    """Write a memory as it is after this substep into the row of the next."""
    k = wp.tid()
    rows[offset[counter[0]] + counter[1] + 1, k] = wp.float64(memory[k])


@wp.kernel(enable_backward=False)
def load_row(
    # in
    offset: wp.array[wp.int32],
    counter: wp.array[wp.int32],
    rows: wp.array2d[wp.float64],
    # out
    memory: wp.array[Any],
) -> None:
    """Set a memory to what it was before this substep."""
    k = wp.tid()
    memory[k] = memory.dtype(rows[offset[counter[0]] + counter[1], k])


@wp.kernel(enable_backward=False)
def take_away(
    # in
    total: wp.array[wp.float64],
    # in, out
    part: wp.array[wp.float64],
) -> None:
    """part becomes total - part."""
    k = wp.tid()
    part[k] = total[k] - part[k]


@wp.kernel(enable_backward=False)
def last_positions(
    # in
    x_start: wp.array[wp.float64],
    history: wp.array2d[Any],
    first_row: int,
    substeps: int,
    dt: wp.float64,
    # out
    x: wp.array[wp.float64],
) -> None:
    """Positions before the last substep of a frame that starts at ``x_start``."""
    k = wp.tid()
    moved = wp.float64(0.0)
    for row in range(first_row + 1, first_row + substeps):
        moved += wp.float64(history[row, k])
    x[k] = x_start[k] + dt * moved


@wp.kernel(enable_backward=False)
def take_nodes_back(
    # model
    mass: wp.array[wp.float64],
    slot: wp.array[wp.int32],
    gravity: wp.vec3d,
    drag: wp.float64,
    offset: wp.array[wp.int32],
    history: wp.array2d[Any],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    earlier_dt: wp.array[wp.float64],
    # in
    x: wp.array[wp.float64],
    # in, out
    x_bar: wp.array[wp.float64],
    v_bar: wp.array[wp.float64],
    mass_bar: wp.array[wp.float64],
    gravity_bar: wp.array[wp.float64],
    drag_bar: wp.array[wp.float64],
    path_x_bar: wp.array2d[wp.float64],
    path_v_bar: wp.array2d[wp.float64],
    # out
    v: wp.array[wp.float64],
    x_previous: wp.array[wp.float64],
    pull: wp.array[wp.float64],
    force_bar: wp.array[wp.float64],
) -> None:
    """One node: from the derivatives after a substep to those of its forces, and to what is known before them."""
    node = wp.tid()
    dt = clock[2]
    row = offset[counter[0]] + counter[1]
    back = dt
    if counter[1] == 0:
        back = earlier_dt[0]
    held = slot[node]
    for i in range(3):
        k = 3 * node + i
        now = wp.float64(history[row, k])
        v[k] = now
        x_previous[k] = x[k] - back * now
        if held >= 0:
            force_bar[k] = wp.float64(0.0)
        else:
            after = wp.float64(history[row + 1, k])
            pull[k] = (after - now) / dt - gravity[i] + drag * now
            a = v_bar[k] + dt * x_bar[k]
            f_bar = dt * a / mass[node]
            force_bar[k] = f_bar
            mass_bar[node] -= f_bar * pull[k]
            gravity_bar[k] += dt * a
            drag_bar[node] -= dt * a * now
            v_bar[k] = (wp.float64(1.0) - dt * drag) * a
    if held >= 0:
        frame = counter[0]
        span = clock[0]
        s = wp.float64(counter[1] + 1) / wp.float64(counter[2])
        h = hermite(s)
        for i in range(3):
            k = 3 * node + i
            p = 3 * held + i
            goal_bar = x_bar[k] + v_bar[k] / dt
            x_bar[k] = -v_bar[k] / dt
            v_bar[k] = wp.float64(0.0)
            path_x_bar[frame, p] += (wp.float64(1.0) - h[0]) * goal_bar
            path_x_bar[frame + 1, p] += h[0] * goal_bar
            path_v_bar[frame, p] += span * h[1] * goal_bar
            path_v_bar[frame + 1, p] += span * h[2] * goal_bar


@wp.kernel(enable_backward=False)
def step_back(
    # in
    x_previous: wp.array[wp.float64],
    # in, out
    previous_bar: wp.array[wp.float64],
    pending: wp.array[wp.float64],
    # out
    x: wp.array[wp.float64],
    x_bar: wp.array[wp.float64],
) -> None:
    """One component to the substep before; what friction asked of the positions before waits one substep."""
    k = wp.tid()
    x_bar[k] += pending[k]
    pending[k] = previous_bar[k]
    previous_bar[k] = wp.float64(0.0)
    x[k] = x_previous[k]


@wp.kernel(enable_backward=False)
def count_back(counter: wp.array[wp.int32]) -> None:
    """The substep before."""
    counter[1] = counter[1] - 1


@wp.kernel(enable_backward=False)
def take_start_back(
    # model
    mass: wp.array[wp.float64],
    gravity: wp.vec3d,
    drag: wp.float64,
    dt: wp.float64,
    # in
    v: wp.array[wp.float64],
    v_half: wp.array[wp.float64],
    # in, out
    v_bar: wp.array[wp.float64],
    mass_bar: wp.array[wp.float64],
    gravity_bar: wp.array[wp.float64],
    drag_bar: wp.array[wp.float64],
    # out
    pull: wp.array[wp.float64],
    force_bar: wp.array[wp.float64],
) -> None:
    """The first half step, v_half = v - dt/2 (f / m + g - c v), taken back at one node."""
    node = wp.tid()
    half = wp.float64(0.5) * dt
    for i in range(3):
        k = 3 * node + i
        pull[k] = (v[k] - v_half[k]) / half - gravity[i] + drag * v[k]
        f_bar = -half * v_bar[k] / mass[node]
        force_bar[k] = f_bar
        mass_bar[node] -= f_bar * pull[k]
        gravity_bar[k] -= half * v_bar[k]
        drag_bar[node] += half * v_bar[k] * v[k]
        v_bar[k] = (wp.float64(1.0) + half * drag) * v_bar[k]


@wp.kernel(enable_backward=False)
def add_work(
    # in
    force_bar: wp.array[wp.float64],
    # in, out
    high: wp.array[wp.float64],
    low: wp.array[wp.float64],
    total: wp.array[wp.float64],
) -> None:
    """Add force_bar . (high - low) of one node; both are cleared."""
    node = wp.tid()
    work = wp.float64(0.0)
    for i in range(3):
        k = 3 * node + i
        work += force_bar[k] * (high[k] - low[k])
        high[k] = wp.float64(0.0)
        low[k] = wp.float64(0.0)
    total[node] += work


@wp.kernel(enable_backward=False)
def add_memory_work(
    # in
    bar: wp.array[wp.float64],
    high: wp.array[Any],
    low: wp.array[Any],
    # out
    total: wp.array[wp.float64],
) -> None:
    """Add bar (high - low) of one number of a memory."""
    k = wp.tid()
    wp.atomic_add(total, 0, bar[k] * (wp.float64(high[k]) - wp.float64(low[k])))


# All that a run can ask for is declared: whatever came later would compile the module anew.
for _real in (wp.float32, wp.float64):
    for _kernel in (keep_row, last_positions, take_nodes_back):
        wp.overload(_kernel, {"history": wp.array2d(dtype=_real)})
    for _kernel in (keep_rows, load_row):
        wp.overload(_kernel, {"memory": wp.array(dtype=_real)})
    wp.overload(add_memory_work, {"high": wp.array(dtype=_real), "low": wp.array(dtype=_real)})
