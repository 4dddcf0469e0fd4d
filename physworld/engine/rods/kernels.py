"""The whole run of a discrete elastic rod in one launch: one thread integrates one copy of it.

Nodes are numbered so that a parent comes before its children; edge i ends at node i and begins at its parent, joint i
is where it meets its parent edge. Every joint has two curvatures and a twist (Bergou et al. 2008, "Discrete elastic
rods"; gradients as in Bergou et al. 2010, "Discrete viscous threads"). Its curvatures are about the directors half way
between those of the two edges that meet there, not about their mean, which is shorter where the rod is twisted: a rod
without natural curvature then bends alike whatever its twist.

    (M + dt D + dt^2 K / 4) dv = dt (f - D v)        x += dt v

with D and K the positive parts of damping and stiffness at the present positions. Without damping this is Newmark's
method of constant average acceleration: no step is too long for a stiff rod, and bending and stretch lose no energy.
A block of the matrix couples a node with its parent and its grandparent only, so it is solved from the leaves to the
root without fill. Twist is solved likewise, fully implicitly: it settles within a few steps, as it does within a
frame in a rope. What tension does across an edge is explicit as far as that is stable (``taut``): as part of the
matrix, which then changes from step to step, it feeds energy into a limp rope that whips. Velocities are those of
half a step after the positions.
"""

from __future__ import annotations

import warp as wp

# columns of `scalars`, one row a copy
RELAXATION_S = wp.constant(0)
TWIST_RELAXATION_S = wp.constant(1)
STRETCH_RELAXATION_S = wp.constant(2)
DRAG_PER_S = wp.constant(3)
DRAG_NORMAL_PER_M = wp.constant(4)
FRICTION_PER_M = wp.constant(5)
FRICTION_ONSET_PER_M = wp.constant(6)
CREEP_RATIO = wp.constant(7)
CREEP_S = wp.constant(8)
GYRATION_M = wp.constant(9)
SCALARS = 10

OPENING = 0.02
"""1 + cos of the angle between two edges: beyond 168 degrees a joint bends no stiffer."""
SHRUNK = 1e-3
"""Length of an edge over its rest length below which it has no direction."""
_OPENING = wp.constant(wp.float64(OPENING))
_SHRUNK = wp.constant(wp.float64(SHRUNK))
_STIFF = wp.constant(wp.float64(0.05))  # of a step: least relaxation of joints far too stiff for it
_TINY = wp.constant(wp.float64(1e-12))


@wp.func
def turned(d: wp.vec3d, t: wp.vec3d, u: wp.vec3d) -> wp.vec3d:
    """``d`` carried by the least rotation that takes the unit vector t to u."""
    axis = wp.cross(t, u)
    once = wp.cross(axis, d)
    return d + once + wp.cross(axis, once) / wp.max(wp.float64(1.0) + wp.dot(t, u), _TINY)


@wp.func
def projected(t: wp.vec3d, along: wp.float64, across: wp.float64) -> wp.mat33d:
    """along t t' + across (1 - t t')."""
    one = wp.identity(n=3, dtype=wp.float64)
    return across * one + (along - across) * wp.outer(t, t)


@wp.func
def inverse_of(m: wp.mat33d) -> wp.mat33d:
    """Inverse of a symmetric matrix, of which the upper triangle is read: symmetric to the bit.

    What rounding makes of the lower one would grow from edge to edge of an elimination.
    """
    a = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    b = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    c = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    d = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]
    e = m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    f = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    over = wp.float64(1.0) / (m[0, 0] * a + m[0, 1] * b + m[0, 2] * c)
    return wp.matrix_from_rows(wp.vec3d(a, b, c), wp.vec3d(b, d, e), wp.vec3d(c, e, f)) * over


@wp.kernel(enable_backward=False)
def run_rods(
    # model, shared by all copies
    parent: wp.array[wp.int32],
    rest_length: wp.array[wp.float64],
    held: wp.array[wp.int32],
    held_edge: wp.array[wp.int32],
    # model, a row a copy
    mass: wp.array2d[wp.float64],
    stretching: wp.array2d[wp.float64],
    bending: wp.array3d[wp.float64],
    torsion: wp.array2d[wp.float64],
    natural: wp.array3d[wp.float64],
    scalars: wp.array2d[wp.float64],
    gravity: wp.array[wp.vec3d],
    # time and what is prescribed
    times: wp.array[wp.float64],
    steps: wp.array[wp.int32],
    path: wp.array3d[wp.vec3d],
    path_rate: wp.array3d[wp.vec3d],
    roll: wp.array3d[wp.float64],
    driven: wp.array2d[wp.vec3d],
    push: wp.array2d[wp.vec3d],
    # which substeps: of the intervals from the first to before the second those from the third to before the fourth
    part: wp.array[wp.int32],
    # in, out: state
    x: wp.array2d[wp.vec3d],
    v: wp.array2d[wp.vec3d],
    director: wp.array2d[wp.vec3d],
    spin: wp.array2d[wp.float64],
    slip: wp.array3d[wp.float64],
    flow: wp.array3d[wp.float64],
    # scratch
    tangent: wp.array2d[wp.vec3d],
    length: wp.array2d[wp.float64],
    own: wp.array2d[wp.mat33d],
    up: wp.array2d[wp.mat33d],
    upup: wp.array2d[wp.mat33d],
    right: wp.array2d[wp.vec3d],
    twist_own: wp.array2d[wp.float64],
    twist_up: wp.array2d[wp.float64],
    torque: wp.array2d[wp.float64],
    pull: wp.array2d[wp.float64],
    # out
    out: wp.array3d[wp.vec3d],
) -> None:
    """Positions at ``times`` (T,) of every copy; ``steps`` (T - 1,) substeps each. See the module's text."""
    c = wp.tid()
    n = x.shape[1]
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    half = wp.float64(0.5)
    quarter = wp.float64(0.25)
    tau = scalars[c, RELAXATION_S]
    tau_twist = scalars[c, TWIST_RELAXATION_S]
    tau_stretch = scalars[c, STRETCH_RELAXATION_S]
    at = wp.min(c, path.shape[0] - 1)  # copies may share their grips
    first_knot = part[0]
    last_knot = part[1]
    first_step = part[2]
    last_step = part[3]
    for i in range(1, n):
        e = x[c, i] - x[c, parent[i]]
        length[c, i] = wp.max(wp.length(e), _SHRUNK * rest_length[i])
        tangent[c, i] = e / length[c, i]
    if first_knot == 0 and first_step == 0:
        for i in range(n):
            out[c, 0, i] = x[c, i]
            if i > 0:
                pull[c, i] = stretching[c, i] * (length[c, i] / rest_length[i] - one)
    for k in range(first_knot, last_knot):
        count = steps[k]
        span = times[k + 1] - times[k]
        dt = span / wp.float64(count)
        for s in range(first_step, wp.min(last_step, count)):
            # rest strains that are driven from inside: two curvatures and a stretch, all along the rod
            share = (wp.float64(s) + half) / wp.float64(count)
            drive = (one - share) * driven[c, k] + share * driven[c, k + 1]
            before = zero  # the step before, half of whose push is in this one: none of it in the first
            if s > 0:
                before = dt
            elif k > 0:
                before = (times[k] - times[k - 1]) / wp.float64(steps[k - 1])
            kick = half * (before + dt) / dt
            ahead = zero  # velocities at the start are not yet those of half a step later
            if before == zero:
                ahead = half * dt
            # own inertia, gravity and drag
            for i in range(n):
                p = parent[i]
                m = mass[c, i]
                t = tangent[c, wp.max(i, 1)]
                speed = v[c, i]
                along = wp.dot(speed, t)
                across = wp.length(speed - along * t)
                rate_t = scalars[c, DRAG_PER_S]
                rate_n = rate_t + scalars[c, DRAG_NORMAL_PER_M] * across
                drag = projected(t, m * rate_t, m * rate_n)
                own[c, i] = m * wp.identity(n=3, dtype=wp.float64) + dt * drag
                up[c, i] = wp.mat33d()
                upup[c, i] = wp.mat33d()
                right[c, i] = dt * (m * gravity[c] + push[c, i] - drag * speed)
                inertia = zero
                if i > 0:
                    gyration = scalars[c, GYRATION_M]
                    inertia = half * (m + mass[c, p]) * gyration * gyration
                twist_own[c, i] = inertia
                twist_up[c, i] = zero
                torque[c, i] = zero
            # stretch
            for i in range(1, n):
                p = parent[i]
                t = tangent[c, i]
                stiff = stretching[c, i] / rest_length[i]
                tension = stiff * (length[c, i] - rest_length[i] * (one + drive[2]))
                damp = stiff * tau_stretch
                apart = v[c, i] - v[c, p]
                rate = wp.dot(apart, t)
                taut = wp.max(pull[c, i] - half * mass[c, i] * length[c, i] / (dt * dt), zero) / length[c, i]
                f = (tension + damp * rate) * t + ahead * projected(t, stiff, taut) * apart
                pull[c, i] = tension + damp * rate
                along = dt * damp + quarter * dt * dt * stiff
                block = projected(t, along, quarter * dt * dt * taut)
                own[c, i] = own[c, i] + block
                own[c, p] = own[c, p] + block
                up[c, i] = up[c, i] - block
                right[c, i] = right[c, i] - dt * f
                right[c, p] = right[c, p] + dt * f
            # bending and twist
            for i in range(2, n):
                p = parent[i]
                if p > 0:
                    g = parent[p]
                    ta = tangent[c, p]
                    tb = tangent[c, i]
                    a1 = director[c, p]
                    b1 = director[c, i]
                    a2 = wp.cross(ta, a1)
                    b2 = wp.cross(tb, b1)
                    chi = wp.max(one + wp.dot(ta, tb), _OPENING)
                    kb = wp.float64(2.0) * wp.cross(ta, tb) / chi
                    mean = (ta + tb) / chi
                    d1 = (a1 + b1) / chi
                    d2 = (a2 + b2) / chi
                    la = length[c, p]
                    lb = length[c, i]
                    u = turned(a1, ta, tb)
                    sine = wp.dot(wp.cross(u, b1), tb)
                    cosine = wp.dot(u, b1)
                    twist = wp.atan2(sine, cosine)
                    gat = half * kb / la
                    gbt = half * kb / lb
                    # the mean of the two directors is cos(twist / 2) long
                    tangent_half = sine / wp.max(one + cosine, _OPENING)
                    longer_by = wp.sqrt(one + tangent_half * tangent_half)
                    k1 = half * longer_by * wp.dot(kb, a2 + b2)
                    k2 = -half * longer_by * wp.dot(kb, a1 + b1)
                    by1 = half * tangent_half * k1
                    by2 = half * tangent_half * k2
                    ga1 = (longer_by * wp.cross(tb, d2) - k1 * mean) / la + by1 * gat
                    gb1 = (-longer_by * wp.cross(ta, d2) - k1 * mean) / lb + by1 * gbt
                    ga2 = (-longer_by * wp.cross(tb, d1) - k2 * mean) / la + by2 * gat
                    gb2 = (longer_by * wp.cross(ta, d1) - k2 * mean) / lb + by2 * gbt
                    ha1 = -half * longer_by * wp.dot(kb, a1) - by1
                    hb1 = -half * longer_by * wp.dot(kb, b1) + by1
                    ha2 = -half * longer_by * wp.dot(kb, a2) - by2
                    hb2 = -half * longer_by * wp.dot(kb, b2) + by2
                    l = half * (rest_length[p] + rest_length[i])
                    va = v[c, p] - v[c, g]
                    vb = v[c, i] - v[c, p]
                    wa = spin[c, p]
                    wb = spin[c, i]
                    rate1 = wp.dot(ga1, va) + wp.dot(gb1, vb) + ha1 * wa + hb1 * wb
                    rate2 = wp.dot(ga2, va) + wp.dot(gb2, vb) + ha2 * wa + hb2 * wb
                    rate3 = wp.dot(gat, va) + wp.dot(gbt, vb) + wb - wa
                    s1 = bending[c, i, 0] / l
                    s2 = bending[c, i, 1] / l
                    s3 = torsion[c, i] / l
                    stiff = wp.float64(4.0) * dt * dt * s1 / (l * l * mass[c, p])
                    stiff = stiff * stiff
                    relax = tau + _STIFF * dt * stiff / (one + stiff)
                    # rate-independent friction (Dahl) and one Maxwell branch, as angles of the joint
                    extra = zero
                    m1 = s1 * (k1 - (natural[c, i, 0] + drive[0]) * l + (relax + ahead) * rate1)
                    m2 = s2 * (k2 - (natural[c, i, 1] + drive[1]) * l + (relax + ahead) * rate2)
                    m3 = s3 * (twist - natural[c, i, 2] * l + (tau_twist + dt) * rate3)
                    friction = scalars[c, FRICTION_PER_M]
                    if friction > zero:
                        onset = scalars[c, FRICTION_ONSET_PER_M] * l
                        move = dt * wp.sqrt(rate1 * rate1 + rate2 * rate2) / onset
                        z1 = (slip[c, i, 0] + dt * rate1 / onset) / (one + move)
                        z2 = (slip[c, i, 1] + dt * rate2 / onset) / (one + move)
                        slip[c, i, 0] = z1
                        slip[c, i, 1] = z2
                        m1 += s1 * l * friction * z1
                        m2 += s2 * l * friction * z2
                        extra += friction * l / onset
                    ratio = scalars[c, CREEP_RATIO]
                    if ratio > zero:
                        fade = wp.exp(-dt / scalars[c, CREEP_S])
                        q1 = k1 + (flow[c, i, 0] - k1) * fade
                        q2 = k2 + (flow[c, i, 1] - k2) * fade
                        flow[c, i, 0] = q1
                        flow[c, i, 1] = q2
                        m1 += ratio * s1 * (k1 - q1)
                        m2 += ratio * s2 * (k2 - q2)
                        extra += ratio
                    fa = m1 * ga1 + m2 * ga2 + m3 * gat
                    fb = m1 * gb1 + m2 * gb2 + m3 * gbt
                    right[c, g] = right[c, g] + dt * fa
                    right[c, p] = right[c, p] - dt * (fa - fb)
                    right[c, i] = right[c, i] - dt * fb
                    w1 = s1 * (dt * relax + quarter * dt * dt * (one + extra))
                    w2 = s2 * (dt * relax + quarter * dt * dt * (one + extra))
                    w3 = s3 * dt * (tau_twist + dt)
                    aa = w1 * wp.outer(ga1, ga1) + w2 * wp.outer(ga2, ga2) + w3 * wp.outer(gat, gat)
                    bb = w1 * wp.outer(gb1, gb1) + w2 * wp.outer(gb2, gb2) + w3 * wp.outer(gbt, gbt)
                    ba = w1 * wp.outer(gb1, ga1) + w2 * wp.outer(gb2, ga2) + w3 * wp.outer(gbt, gat)
                    ab = wp.transpose(ba)
                    own[c, g] = own[c, g] + aa
                    own[c, p] = own[c, p] + aa + bb - ab - ba
                    own[c, i] = own[c, i] + bb
                    up[c, p] = up[c, p] - aa + ba
                    up[c, i] = up[c, i] + ba - bb
                    upup[c, i] = upup[c, i] - ba
                    torque[c, p] = torque[c, p] - m1 * ha1 - m2 * ha2 + m3
                    torque[c, i] = torque[c, i] - m1 * hb1 - m2 * hb2 - m3
                    y1 = s1 * (dt * relax + dt * dt * (one + extra))
                    y2 = s2 * (dt * relax + dt * dt * (one + extra))
                    y3 = s3 * dt * (tau_twist + dt)
                    twist_own[c, p] = twist_own[c, p] + y1 * ha1 * ha1 + y2 * ha2 * ha2 + y3
                    twist_own[c, i] = twist_own[c, i] + y1 * hb1 * hb1 + y2 * hb2 * hb2 + y3
                    twist_up[c, i] = twist_up[c, i] + y1 * ha1 * hb1 + y2 * ha2 * hb2 - y3
            # what is prescribed at the end of the substep
            w = wp.float64(s + 1) / wp.float64(count)
            w2_ = w * w
            w3_ = w2_ * w
            h00 = wp.float64(2.0) * w3_ - wp.float64(3.0) * w2_ + one
            h10 = (w3_ - wp.float64(2.0) * w2_ + w) * span
            h01 = one - h00
            h11 = (w3_ - w2_) * span
            for i in range(n):
                right[c, i] = kick * right[c, i]
            # leaves to root
            for back in range(n):
                i = n - 1 - back
                p = parent[i]
                j = held[i]
                if j >= 0:
                    goal = (
                        h00 * path[at, k, j]
                        + h10 * path_rate[at, k, j]
                        + h01 * path[at, k + 1, j]
                        + h11 * path_rate[at, k + 1, j]
                    )
                    dv = (goal - x[c, i]) / dt - v[c, i]
                    if i > 0:
                        right[c, p] = right[c, p] - wp.transpose(up[c, i]) * dv
                        if p > 0:
                            g = parent[p]
                            right[c, g] = right[c, g] - wp.transpose(upup[c, i]) * dv
                    right[c, i] = dv
                else:
                    inverse = inverse_of(own[c, i])
                    own[c, i] = inverse
                    if i > 0:
                        yp = inverse * up[c, i]
                        r = right[c, i]
                        own[c, p] = own[c, p] - wp.transpose(up[c, i]) * yp
                        right[c, p] = right[c, p] - wp.transpose(yp) * r
                        if p > 0:
                            g = parent[p]
                            yg = inverse * upup[c, i]
                            own[c, g] = own[c, g] - wp.transpose(upup[c, i]) * yg
                            up[c, p] = up[c, p] - wp.transpose(up[c, i]) * yg
                            right[c, g] = right[c, g] - wp.transpose(yg) * r
                if i > 0:
                    q = held_edge[i]
                    if q >= 0:
                        change = (roll[at, k + 1, q] - roll[at, k, q]) / span - spin[c, i]
                        torque[c, p] = torque[c, p] - twist_up[c, i] * change / dt
                        torque[c, i] = change
                        twist_own[c, i] = one
                        twist_up[c, i] = zero
                    else:
                        ratio_up = twist_up[c, i] / twist_own[c, i]
                        twist_own[c, p] = twist_own[c, p] - twist_up[c, i] * ratio_up
                        torque[c, p] = torque[c, p] - ratio_up * torque[c, i]
                        torque[c, i] = dt * torque[c, i] / twist_own[c, i]
                        twist_up[c, i] = ratio_up
            # root to leaves
            for i in range(n):
                p = parent[i]
                if held[i] < 0:
                    r = right[c, i]
                    if i > 0:
                        r = r - up[c, i] * right[c, p]
                        if p > 0:
                            r = r - upup[c, i] * right[c, parent[p]]
                    right[c, i] = own[c, i] * r
                if i > 0:  # the mean tension over the step
                    rate = wp.dot(right[c, i] - right[c, p], tangent[c, i])
                    stiff = stretching[c, i] / rest_length[i]
                    pull[c, i] = pull[c, i] + (tau_stretch + quarter * dt) * stiff * rate
                v[c, i] = v[c, i] + right[c, i]
                x[c, i] = x[c, i] + dt * v[c, i]
                if i > 0:
                    turn = torque[c, i]
                    if p > 0 and held_edge[i] < 0:
                        turn = turn - twist_up[c, i] * torque[c, p]
                    torque[c, i] = turn
                    spin[c, i] = spin[c, i] + turn
                    e = x[c, i] - x[c, p]
                    longer = wp.max(wp.length(e), _SHRUNK * rest_length[i])
                    t = e / longer
                    angle = dt * spin[c, i]
                    d = turned(director[c, i], tangent[c, i], t)
                    d = d * wp.cos(angle) + wp.cross(t, d) * wp.sin(angle)
                    d = d - wp.dot(d, t) * t
                    director[c, i] = d / wp.length(d)
                    tangent[c, i] = t
                    length[c, i] = longer
        if last_step >= count:
            for i in range(n):
                out[c, k + 1, i] = x[c, i]


@wp.kernel
def enter_interval(
    frame: int,
    times: wp.array[wp.float64],
    steps: wp.array[wp.int32],
    part: wp.array[wp.int32],
    counter: wp.array[wp.int32],
    clock: wp.array[wp.float64],
) -> None:
    """Set what :func:`run_rods` and terms read before the first substep of an interval."""
    count = steps[frame]
    span = times[frame + 1] - times[frame]
    part[0] = frame
    part[1] = frame + 1
    part[2] = 0
    part[3] = 1
    counter[0] = frame
    counter[1] = 0
    counter[2] = count
    clock[0] = span
    clock[2] = span / wp.float64(count)
    clock[1] = wp.float64(1.0) / clock[2]


@wp.kernel
def next_substep(part: wp.array[wp.int32], counter: wp.array[wp.int32]) -> None:
    """Go one substep on."""
    part[2] = part[2] + 1
    part[3] = part[3] + 1
    counter[1] = counter[1] + 1
