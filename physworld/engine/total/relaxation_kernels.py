"""Device side of the nodes where friction is sub-cycled: the stages of one Runge-Kutta-Legendre step of the velocities.

    dv/dt = r(v),   r(v) = (f - C v) / m + g - c v        f, C frozen at the positions of the step

Prescribed nodes have the velocity of the step's whole way throughout. See :mod:`physworld.engine.total.relaxation`.

Legend: source f / m + g; y0, y1, y2 the velocities at the step's start and of the last two stages; a, b, own, first the
coefficients of a stage; clock, counter as in :mod:`physworld.engine.total.node_kernels`.
"""

from __future__ import annotations

import warp as wp

from physworld.engine.total.node_kernels import on_path


@wp.kernel(enable_backward=False)
def begin_stages(
    # model
    mass: wp.array[wp.float64],
    slot: wp.array[wp.int32],
    path_x: wp.array2d[wp.float64],
    path_v: wp.array2d[wp.float64],
    gravity: wp.vec3d,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
    # in, out
    force: wp.array[wp.float64],
    # out
    source: wp.array[wp.float64],
    y0: wp.array[wp.float64],
    y2: wp.array[wp.float64],
    mean: wp.array[wp.float64],
) -> None:
    """One node: its force is read and cleared, its velocity is where the stages start."""
    node = wp.tid()
    held = slot[node]
    s = wp.float64(counter[1] + 1) / wp.float64(counter[2])
    for i in range(3):
        k = 3 * node + i
        if held >= 0:
            goal = on_path(path_x, path_v, counter[0], 3 * held + i, s, clock[0])
            y0[k] = (goal - x[k]) / clock[2]
            source[k] = wp.float64(0.0)
        else:
            y0[k] = v[k]
            source[k] = force[k] / mass[node] + gravity[i]
        y2[k] = y0[k]
        force[k] = wp.float64(0.0)
        mean[k] = wp.float64(0.0)


_STAGE = r"""
    const double dt = counter.data[0] == 0 && counter.data[1] == 0 ? 0.5 * clock.data[2] : clock.data[2];
    const double stay = 1.0 - a - b;
    const int end = (part + 1) * block < size ? (part + 1) * block : size;
    const double* __restrict__ m = inverse_mass.data;
    const double* __restrict__ s = source.data;
    const double* __restrict__ at = y0.data;
    const double* __restrict__ now = y1.data;
    double* __restrict__ pull = friction.data;
    double* __restrict__ r0 = rate0.data;
    double* __restrict__ sum = mean.data;
    double* __restrict__ out = y2.data;
    for (int k = part * block; k < end; ++k) {
        const double rate = s[k] + pull[k] * m[k] - (m[k] > 0.0 ? drag : 0.0) * now[k];
        sum[k] += share * now[k];
        pull[k] = 0.0;
        if (starting) {
            r0[k] = rate;
            out[k] = now[k] + dt * own * rate;
        } else {
            out[k] = a * now[k] + b * out[k] + stay * at[k] + dt * (own * rate + first * r0[k]);
        }
    }
"""


@wp.func_native(_STAGE)
def stage_of_components(
    part: int,
    block: int,
    size: int,
    # model
    inverse_mass: wp.array[wp.float64],
    drag: wp.float64,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    starting: int,
    a: wp.float64,
    b: wp.float64,
    own: wp.float64,
    first: wp.float64,
    share: wp.float64,
    # in
    source: wp.array[wp.float64],
    y0: wp.array[wp.float64],
    y1: wp.array[wp.float64],
    # in, out
    friction: wp.array[wp.float64],
    rate0: wp.array[wp.float64],
    mean: wp.array[wp.float64],
    y2: wp.array[wp.float64],
) -> None: ...


@wp.kernel(enable_backward=False)
def take_stage(
    # model
    block: int,
    inverse_mass: wp.array[wp.float64],
    drag: wp.float64,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    starting: int,
    a: wp.float64,
    b: wp.float64,
    own: wp.float64,
    first: wp.float64,
    share: wp.float64,
    # in
    source: wp.array[wp.float64],
    y0: wp.array[wp.float64],
    y1: wp.array[wp.float64],
    # in, out
    friction: wp.array[wp.float64],
    rate0: wp.array[wp.float64],
    mean: wp.array[wp.float64],
    y2: wp.array[wp.float64],
) -> None:
    """y2 becomes a y1 + b y2 + (1 - a - b) y0 + dt (own r(y1) + first r(y0)); the friction -C y1 is read and cleared.

    A thread takes ``block`` components; ``inverse_mass`` (3n,) is 0 where nodes are prescribed. ``share`` is the
    stage's part of the mean velocity at which the step took its friction. A run's first step is half a step: it takes
    the velocities from the start to the middle of the first move.
    """
    stage_of_components(
        wp.tid(), block, y1.shape[0], inverse_mass, drag, clock, counter, starting, a, b, own, first, share,
        source, y0, y1, friction, rate0, mean, y2,
    )  # fmt: skip


@wp.kernel(enable_backward=False)
def end_stages(
    # model
    slot: wp.array[wp.int32],
    path_x: wp.array2d[wp.float64],
    path_v: wp.array2d[wp.float64],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in
    y: wp.array[wp.float64],
    # out
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
) -> None:
    """One node moves with the velocity of the last stage; a prescribed one to its place."""
    node = wp.tid()
    held = slot[node]
    s = wp.float64(counter[1] + 1) / wp.float64(counter[2])
    for i in range(3):
        k = 3 * node + i
        v[k] = y[k]
        if held >= 0:
            x[k] = on_path(path_x, path_v, counter[0], 3 * held + i, s, clock[0])
        else:
            x[k] = x[k] + clock[2] * y[k]
