"""Device side of a substep whose friction is taken in stages, backwards: the nodes before, between and after stages.

With y_j the velocities after stage j, r the rates of :mod:`physworld.engine.total.relaxation_kernels`, a, b, own and
first the coefficients of the stage, and bars for derivatives of the result:

    y_j       = a y_(j-1) + b y_(j-2) + (1 - a - b) y_0 + dt (own r(y_(j-1)) + first r(y_0))
    ybar_j-1 += a ybar_j + (dr/dy)^T z,    z = dt own ybar_j (the first stage: and dt first ybar_i of all later ones)
    ybar_j-2 += b ybar_j                   ybar_0 += (1 - a - b) ybar_j
    (dr/dy)^T z = -C u - c z,              u = z / m of free nodes: the derivative by the stage's force f - C y_(j-1)

C is symmetric, so the transposed stages apply the same friction. The sum of u over the stages is w, the derivative by
the forces f.

Legend: q_j = -C y_j [N]; cur, before the derivatives by the velocities of this stage and of the one before it; clock,
counter, history as in :mod:`physworld.engine.gradients.adjoint_kernels`.
"""

from __future__ import annotations

from typing import Any

import warp as wp


@wp.func
def stage_step(clock: wp.array[wp.float64], counter: wp.array[wp.int32]) -> wp.float64:
    """Time that the stages take [s]: a run's first are half a step."""
    if counter[0] == 0 and counter[1] == 0:
        return wp.float64(0.5) * clock[2]
    return clock[2]


@wp.kernel(enable_backward=False)
def enter_stages_back(
    # model
    mass: wp.array[wp.float64],
    slot: wp.array[wp.int32],
    gravity: wp.vec3d,
    offset: wp.array[wp.int32],
    history: wp.array2d[Any],
    forces: wp.array2d[Any],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    earlier_dt: wp.array[wp.float64],
    # in
    x: wp.array[wp.float64],
    v_bar: wp.array[wp.float64],
    # in, out
    x_bar: wp.array[wp.float64],
    # out
    v: wp.array[wp.float64],
    x_previous: wp.array[wp.float64],
    pull: wp.array[wp.float64],
    source: wp.array[wp.float64],
    y0: wp.array[wp.float64],
    cur: wp.array[wp.float64],
    before: wp.array[wp.float64],
    y0_bar: wp.array[wp.float64],
    rate0_bar: wp.array[wp.float64],
    goal_bar: wp.array[wp.float64],
    force_bar: wp.array[wp.float64],
) -> None:
    """One node: what its stages start from, and the derivatives by the velocities of the last."""
    node = wp.tid()
    row = offset[counter[0]] + counter[1]
    back = clock[2]
    if counter[1] == 0:
        back = earlier_dt[0]
    zero = wp.float64(0.0)
    for i in range(3):
        k = 3 * node + i
        now = wp.float64(history[row, k])
        v[k] = now
        x_previous[k] = x[k] - back * now
        before[k] = zero
        y0_bar[k] = zero
        rate0_bar[k] = zero
        force_bar[k] = zero
        cur[k] = v_bar[k]
        if slot[node] >= 0:
            pull[k] = zero
            source[k] = zero
            y0[k] = wp.float64(history[row + 1, k])
            goal_bar[k] = x_bar[k]
            x_bar[k] = zero
        else:
            pull[k] = wp.float64(forces[row, k]) / mass[node]
            source[k] = pull[k] + gravity[i]
            y0[k] = now
            cur[k] += clock[2] * x_bar[k]


@wp.kernel(enable_backward=False)
def take_stage_again(
    # model
    inverse_mass: wp.array[wp.float64],
    drag: wp.float64,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    a: wp.float64,
    b: wp.float64,
    own: wp.float64,
    first: wp.float64,
    # in
    source: wp.array[wp.float64],
    y0: wp.array[wp.float64],
    q0: wp.array[wp.float64],
    y_before: wp.array[wp.float64],
    y: wp.array[wp.float64],
    q: wp.array[wp.float64],
    # out
    y_next: wp.array[wp.float64],
) -> None:
    """One component of the velocities after a stage; ``inverse_mass`` is 0 where nodes are prescribed."""
    k = wp.tid()
    share = inverse_mass[k]
    rate = wp.float64(0.0)
    rate0 = wp.float64(0.0)
    if share > wp.float64(0.0):
        rate = source[k] + q[k] * share - drag * y[k]
        rate0 = source[k] + q0[k] * share - drag * y0[k]
    stay = wp.float64(1.0) - a - b
    dt = stage_step(clock, counter)
    y_next[k] = a * y[k] + b * y_before[k] + stay * y0[k] + dt * (own * rate + first * rate0)


@wp.kernel(enable_backward=False)
def open_stage_back(
    # model
    inverse_mass: wp.array[wp.float64],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    lag_clock: wp.array[wp.float64],
    is_first: int,
    stay: wp.float64,
    own: wp.float64,
    first: wp.float64,
    # in
    cur: wp.array[wp.float64],
    x: wp.array[wp.float64],
    y: wp.array[wp.float64],
    # in, out
    rate0_bar: wp.array[wp.float64],
    y0_bar: wp.array[wp.float64],
    # out
    u: wp.array[wp.float64],
    pushed: wp.array[wp.float64],
    x_lagged: wp.array[wp.float64],
) -> None:
    """One component of u, and of the positions a lag before ``x`` at the velocities ``y`` of the stage's rate."""
    k = wp.tid()
    dt = stage_step(clock, counter)
    z = dt * own * cur[k]
    if is_first == 1:
        z += rate0_bar[k]
    rate0_bar[k] += dt * first * cur[k]
    y0_bar[k] += stay * cur[k]
    u[k] = inverse_mass[k] * z
    pushed[k] = wp.float64(0.0)
    x_lagged[k] = x[k] - lag_clock[2] * y[k]


@wp.kernel(enable_backward=False)
def close_stage_back(
    # model
    mass: wp.array[wp.float64],
    drag: wp.float64,
    a: wp.float64,
    b: wp.float64,
    # in
    y: wp.array[wp.float64],
    q: wp.array[wp.float64],
    pull: wp.array[wp.float64],
    u: wp.array[wp.float64],
    pushed: wp.array[wp.float64],
    # in, out
    cur: wp.array[wp.float64],
    before: wp.array[wp.float64],
    force_bar: wp.array[wp.float64],
    mass_bar: wp.array[wp.float64],
    gravity_bar: wp.array[wp.float64],
    drag_bar: wp.array[wp.float64],
) -> None:
    """One node to the stage before; ``pushed`` is -C u [N], u is 0 at prescribed nodes."""
    node = wp.tid()
    for i in range(3):
        k = 3 * node + i
        z = mass[node] * u[k]
        now = cur[k]
        cur[k] = before[k] + a * now + pushed[k] - drag * z
        before[k] = b * now
        force_bar[k] += u[k]
        mass_bar[node] -= u[k] * (pull[k] + q[k] / mass[node])
        gravity_bar[k] += z
        drag_bar[node] -= z * y[k]


@wp.kernel(enable_backward=False)
def leave_stages_back(
    # model
    slot: wp.array[wp.int32],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in
    cur: wp.array[wp.float64],
    y0_bar: wp.array[wp.float64],
    goal_bar: wp.array[wp.float64],
    # in, out
    x_bar: wp.array[wp.float64],
    path_x_bar: wp.array2d[wp.float64],
    path_v_bar: wp.array2d[wp.float64],
    # out
    v_bar: wp.array[wp.float64],
) -> None:
    """One node: the derivatives by the velocity its stages started from; a prescribed one's go to its path."""
    node = wp.tid()
    held = slot[node]
    frame = counter[0]
    s = wp.float64(counter[1] + 1) / wp.float64(counter[2])
    s2 = s * s
    s3 = s2 * s
    h01 = wp.float64(3.0) * s2 - wp.float64(2.0) * s3
    h10 = s3 - wp.float64(2.0) * s2 + s
    h11 = s3 - s2
    for i in range(3):
        k = 3 * node + i
        found = cur[k] + y0_bar[k]
        if held < 0:
            v_bar[k] = found
        else:
            v_bar[k] = wp.float64(0.0)
            p = 3 * held + i
            goal = goal_bar[k] + found / clock[2]
            x_bar[k] -= found / clock[2]
            path_x_bar[frame, p] += (wp.float64(1.0) - h01) * goal
            path_x_bar[frame + 1, p] += h01 * goal
            path_v_bar[frame, p] += clock[0] * h10 * goal
            path_v_bar[frame + 1, p] += clock[0] * h11 * goal


# All that a run can ask for is declared: whatever came later would compile the module anew.
for _real in (wp.float32, wp.float64):
    wp.overload(enter_stages_back, {"history": wp.array2d(dtype=_real), "forces": wp.array2d(dtype=_real)})
