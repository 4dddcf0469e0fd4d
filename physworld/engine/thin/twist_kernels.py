"""Device side of twist: the angle of every span of a rope between two grips, and the forces that it makes.

Along the unit tangents t_0 (of the grip), t_1 ... t_M (of the particles), t_(M+1) (of the other grip) a vector is
carried from each to the next by the rotation of least angle. The twist angle is from the first grip's director, so
carried, to the second's, about t_(M+1). With kb = 2 t x u / (1 + t . u) of neighbours t and u its variation is

    d Theta / dt_i = (kb_(i-1, i) + kb_(i, i+1)) / 2        (Bergou et al. 2008)

Legend: a span's paths are (tangent, director) of its low end, then of its high end; along = unit tangents;
inverse = 1 / |x'|; narrow = 1 + cosine of the largest angle between neighbours; clock, counter as everywhere.
"""

from __future__ import annotations

import warp as wp

from physworld.engine.total.node_kernels import on_path

wp.set_module_options({"enable_backward": False})


@wp.func
def _slope(
    values: wp.array[wp.float64], nodes: wp.array2d[wp.int32], slopes: wp.array2d[wp.float64],
    point: int,
) -> wp.vec3d:  # fmt: skip
    """Derivative of nodal ``values`` by the arc length at a particle."""
    total = wp.vec3d()
    for a in range(3):
        node = 3 * nodes[point, a]
        total += slopes[point, a] * wp.vec3d(values[node], values[node + 1], values[node + 2])
    return total


@wp.func
def _carried(m: wp.vec3d, t: wp.vec3d, u: wp.vec3d) -> wp.vec3d:
    """``m`` turned by the rotation of least angle that takes ``t`` to ``u``."""
    axis = wp.cross(t, u)
    first = wp.cross(axis, m)
    return m + first + wp.cross(axis, first) / wp.max(wp.float64(1.0) + wp.dot(t, u), wp.float64(1.0e-9))


@wp.func
def _binormal(t: wp.vec3d, u: wp.vec3d) -> wp.vec3d:
    """2 tan(angle / 2) along t x u."""
    return wp.float64(2.0) / wp.max(wp.float64(1.0) + wp.dot(t, u), wp.float64(1.0e-9)) * wp.cross(t, u)


@wp.func
def _binormal_rate(t: wp.vec3d, u: wp.vec3d, dt: wp.vec3d, du: wp.vec3d) -> wp.vec3d:
    """Change of :func:`_binormal` with changes of ``t`` and ``u``."""
    room = wp.max(wp.float64(1.0) + wp.dot(t, u), wp.float64(1.0e-9))
    turned = wp.float64(2.0) * (wp.cross(dt, u) + wp.cross(t, du))
    return (turned - (wp.dot(dt, u) + wp.dot(t, du)) * _binormal(t, u)) / room


@wp.func
def _prescribed(
    path_x: wp.array2d[wp.float64], path_v: wp.array2d[wp.float64], clock: wp.array[wp.float64],
    counter: wp.array[wp.int32], first: int,
) -> wp.vec3d:  # fmt: skip
    """Three neighbouring columns of the paths now."""
    s = wp.float64(counter[1]) / wp.float64(counter[2])
    frame = wp.min(counter[0], path_x.shape[0] - 2)
    if counter[0] > frame:
        s = wp.float64(1.0)
    return wp.vec3d(
        on_path(path_x, path_v, frame, first, s, clock[0]),
        on_path(path_x, path_v, frame, first + 1, s, clock[0]),
        on_path(path_x, path_v, frame, first + 2, s, clock[0]),
    )


@wp.kernel
def turn_spans(
    # model
    begins: wp.array[wp.int32],
    nodes: wp.array2d[wp.int32],
    slopes: wp.array2d[wp.float64],
    compliance: wp.array[wp.float64],
    path_x: wp.array2d[wp.float64],
    path_v: wp.array2d[wp.float64],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in
    x: wp.array[wp.float64],
    # in, out
    angle: wp.array[wp.float64],
    narrow: wp.array[wp.float64],
    # out
    along: wp.array[wp.vec3d],
    inverse: wp.array[wp.float64],
    ends: wp.array[wp.vec3d],
    moment: wp.array[wp.float64],
) -> None:
    """Angle [rad] and moment [N m] of a span; the angle is followed from the last substep's, over any turns."""
    span = wp.tid()
    t = wp.normalize(_prescribed(path_x, path_v, clock, counter, 12 * span))
    m = _prescribed(path_x, path_v, clock, counter, 12 * span + 3)
    m = wp.normalize(m - wp.dot(m, t) * t)
    u = wp.normalize(_prescribed(path_x, path_v, clock, counter, 12 * span + 6))
    goal = _prescribed(path_x, path_v, clock, counter, 12 * span + 9)
    goal = wp.normalize(goal - wp.dot(goal, u) * u)
    ends[4 * span] = t
    ends[4 * span + 1] = m
    ends[4 * span + 2] = u
    ends[4 * span + 3] = goal
    before = angle[span]
    least = narrow[span]
    if counter[0] == 0 and counter[1] == 0:
        before = wp.float64(0.0)
        least = wp.float64(2.0)
    for point in range(begins[span], begins[span + 1]):
        slope = _slope(x, nodes, slopes, point)
        size = wp.max(wp.length(slope), wp.float64(1.0e-12))
        next = slope / size
        along[point] = next
        inverse[point] = wp.float64(1.0) / size
        m = _carried(m, t, next)
        least = wp.min(least, wp.float64(1.0) + wp.dot(t, next))
        t = next
    m = _carried(m, t, u)
    narrow[span] = wp.min(least, wp.float64(1.0) + wp.dot(t, u))
    turn = wp.float64(2.0) * wp.float64(wp.PI)
    found = wp.atan2(wp.dot(wp.cross(m, goal), u), wp.dot(m, goal))
    found += turn * wp.round((before - found) / turn)
    angle[span] = found
    moment[span] = found / compliance[span]


@wp.func
def _neighbours(
    point: int, span: int, begins: wp.array[wp.int32], along: wp.array[wp.vec3d],
    ends: wp.array[wp.vec3d],
) -> tuple[wp.vec3d, wp.vec3d]:  # fmt: skip
    """Unit tangents before and after a particle."""
    before = ends[4 * span]
    if point > begins[span]:
        before = along[point - 1]
    after = ends[4 * span + 2]
    if point + 1 < begins[span + 1]:
        after = along[point + 1]
    return before, after


@wp.kernel
def push_twisted(
    # model
    begins: wp.array[wp.int32],
    span_of: wp.array[wp.int32],
    nodes: wp.array2d[wp.int32],
    slopes: wp.array2d[wp.float64],
    # in
    along: wp.array[wp.vec3d],
    inverse: wp.array[wp.float64],
    ends: wp.array[wp.vec3d],
    moment: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Add - moment dTheta/dx [N] of one particle's tangent to its nodes."""
    point = wp.tid()
    span = span_of[point]
    here = along[point]
    before, after = _neighbours(point, span, begins, along, ends)
    both = _binormal(before, here) + _binormal(here, after)
    push = wp.float64(-0.5) * moment[span] * inverse[point] * both
    for a in range(3):
        for i in range(3):
            wp.atomic_add(force, 3 * nodes[point, a] + i, slopes[point, a] * push[i])


@wp.kernel
def turn_spans_along(
    # model
    begins: wp.array[wp.int32],
    nodes: wp.array2d[wp.int32],
    slopes: wp.array2d[wp.float64],
    compliance: wp.array[wp.float64],
    # in
    along: wp.array[wp.vec3d],
    inverse: wp.array[wp.float64],
    ends: wp.array[wp.vec3d],
    moment: wp.array[wp.float64],
    w: wp.array[wp.float64],
    # out
    along_rate: wp.array[wp.vec3d],
    moment_rate: wp.array[wp.float64],
    by_log_stiffness: wp.array[wp.float64],
) -> None:
    """How unit tangents and moment change with the nodes along ``w``; adds w . f to ``by_log_stiffness``."""
    span = wp.tid()
    rate = wp.float64(0.0)
    for point in range(begins[span], begins[span + 1]):
        before, after = _neighbours(point, span, begins, along, ends)
        here = along[point]
        change = inverse[point] * _slope(w, nodes, slopes, point)
        change -= wp.dot(here, change) * here
        along_rate[point] = change
        rate += wp.float64(0.5) * wp.dot(change, _binormal(before, here) + _binormal(here, after))
    moment_rate[span] = rate / compliance[span]
    by_log_stiffness[span] = by_log_stiffness[span] - moment[span] * rate


@wp.kernel
def push_twisted_along(
    # model
    begins: wp.array[wp.int32],
    span_of: wp.array[wp.int32],
    nodes: wp.array2d[wp.int32],
    slopes: wp.array2d[wp.float64],
    # in
    along: wp.array[wp.vec3d],
    inverse: wp.array[wp.float64],
    ends: wp.array[wp.vec3d],
    moment: wp.array[wp.float64],
    along_rate: wp.array[wp.vec3d],
    moment_rate: wp.array[wp.float64],
    w: wp.array[wp.float64],
    # out
    out: wp.array[wp.float64],
) -> None:
    """Add the change of :func:`push_twisted`'s forces with the nodes along ``w``."""
    point = wp.tid()
    span = span_of[point]
    here = along[point]
    change = along_rate[point]
    before, after = _neighbours(point, span, begins, along, ends)
    before_rate = wp.vec3d()
    if point > begins[span]:
        before_rate = along_rate[point - 1]
    after_rate = wp.vec3d()
    if point + 1 < begins[span + 1]:
        after_rate = along_rate[point + 1]
    both = _binormal(before, here) + _binormal(here, after)
    both_rate = _binormal_rate(before, here, before_rate, change)
    both_rate += _binormal_rate(here, after, change, after_rate)
    longer = inverse[point] * wp.dot(here, _slope(w, nodes, slopes, point))
    push = moment_rate[span] * both + moment[span] * (both_rate - longer * both)
    push *= wp.float64(-0.5) * inverse[point]
    for a in range(3):
        for i in range(3):
            wp.atomic_add(out, 3 * nodes[point, a] + i, slopes[point, a] * push[i])


@wp.kernel
def sum_turning(
    # model
    begins: wp.array[wp.int32],
    counter: wp.array[wp.int32],
    # in
    along: wp.array[wp.vec3d],
    ends: wp.array[wp.vec3d],
    angle: wp.array[wp.float64],
    moment: wp.array[wp.float64],
    # in, out: of the last substep
    last_ends: wp.array[wp.vec3d],
    last_bends: wp.array[wp.vec3d],
    last_moment: wp.array[wp.float64],
    work: wp.array[wp.float64],
    # out
    work_out: wp.array2d[wp.float64],
    energy_out: wp.array2d[wp.float64],
) -> None:
    """Work [J] that the grips of a span do by turning its ends, by the trapezoidal rule; written at a frame.

    What they turn about the axis counts in full; that they move the axis counts with the holonomy's variation.
    """
    span = wp.tid()
    low = _binormal(ends[4 * span], along[begins[span]])
    high = _binormal(along[begins[span + 1] - 1], ends[4 * span + 2])
    if counter[0] == 0 and counter[1] == 0:
        work[span] = wp.float64(0.0)
    else:
        turned = wp.float64(0.0)
        for side in range(2):
            k = 4 * span + 2 * side
            t = ends[k]
            m = _carried(last_ends[k + 1], last_ends[k], t)
            about = wp.atan2(wp.dot(wp.cross(m, ends[k + 1]), t), wp.dot(m, ends[k + 1]))
            bend = low
            if side == 0:
                about = -about
            else:
                bend = high
            turned += about + wp.float64(0.25) * wp.dot(bend + last_bends[2 * span + side], t - last_ends[k])
        work[span] = work[span] + wp.float64(0.5) * (moment[span] + last_moment[span]) * turned
    for k in range(4):
        last_ends[4 * span + k] = ends[4 * span + k]
    last_bends[2 * span] = low
    last_bends[2 * span + 1] = high
    last_moment[span] = moment[span]
    if counter[1] == 0:
        work_out[counter[0], span] = work[span]
        energy_out[counter[0], span] = wp.float64(0.5) * moment[span] * angle[span]
