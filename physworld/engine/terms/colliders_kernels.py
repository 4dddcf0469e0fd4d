"""Device side of rigid colliders: their pose at a substep, and the contact of one point of a body with one of them.

Legend: clock = (frame interval [s], 1/dt [1/s], dt [s]); counter = (frame, substep, substeps of this frame);
pose = (position [m], three rows of the rotation to the world, velocity [m/s], angular velocity [rad/s]);
totals = (impulse on the body [N s] (3), greatest depth [m]).
"""

from __future__ import annotations

import warp as wp

from physworld.engine.total.node_kernels import weighted_sum
from physworld.shapes.sdf_kernels import signed_distance

ROUND_OFF_M = 1e-9  # a point that is nearer than this is looked at


@wp.func
def _turn(h: wp.vec3d) -> wp.mat33d:
    """exp of a rotation vector."""
    angle = wp.length(h)
    one = wp.identity(n=3, dtype=wp.float64)
    k = wp.skew(h)
    if angle < wp.float64(1.0e-8):
        return one + k
    s = wp.sin(wp.float64(0.5) * angle) / angle
    return one + wp.sin(angle) / angle * k + wp.float64(2.0) * s * s * k * k


@wp.func
def _spin(h: wp.vec3d, rate: wp.vec3d) -> wp.vec3d:
    """Angular velocity in the turned frame of a rotation vector ``h`` that changes at ``rate``."""
    angle = wp.length(h)
    first = wp.cross(h, rate)
    if angle < wp.float64(1.0e-4):
        return rate - wp.float64(0.5) * first
    s = wp.sin(wp.float64(0.5) * angle) / angle
    rest = (angle - wp.sin(angle)) / (angle * angle * angle)
    return rate - wp.float64(2.0) * s * s * first + rest * wp.cross(h, first)


@wp.kernel
def move_collider(
    # model
    frame_times: wp.array[wp.float64],
    knots: wp.array[wp.float64],
    positions: wp.array[wp.vec3d],
    velocities: wp.array[wp.vec3d],
    turns: wp.array[wp.vec3d],
    first_rates: wp.array[wp.vec3d],
    last_rates: wp.array[wp.vec3d],
    rotations: wp.array[wp.mat33d],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # out
    pose: wp.array[wp.vec3d],
    totals: wp.array[wp.float64],
) -> None:
    """Pose at the start of a substep; a run's first substep clears the totals."""
    if counter[0] == 0 and counter[1] == 0:
        for i in range(4):
            totals[i] = wp.float64(0.0)
    two, three = wp.float64(2.0), wp.float64(3.0)
    time = frame_times[counter[0]] + clock[0] * wp.float64(counter[1]) / wp.float64(counter[2])
    last = knots.shape[0] - 1
    place = positions[0]
    turn = rotations[0]
    velocity = wp.vec3d()
    spin = wp.vec3d()
    if time >= knots[last]:
        place = positions[last]
        turn = rotations[last]
    elif time > knots[0]:
        k = wp.lower_bound(knots, time) - 1
        span = knots[k + 1] - knots[k]
        s = (time - knots[k]) / span
        s2 = s * s
        h01 = three * s2 - two * s2 * s
        h10 = s2 * s - two * s2 + s
        h11 = s2 * s - s2
        d01 = wp.float64(6.0) * (s - s2) / span
        d10 = three * s2 - wp.float64(4.0) * s + wp.float64(1.0)
        d11 = three * s2 - two * s
        chord = positions[k + 1] - positions[k]
        place = positions[k] + h01 * chord + span * (h10 * velocities[k] + h11 * velocities[k + 1])
        velocity = d01 * chord + d10 * velocities[k] + d11 * velocities[k + 1]
        h = h01 * turns[k] + span * (h10 * first_rates[k] + h11 * last_rates[k])
        rate = d01 * turns[k] + d10 * first_rates[k] + d11 * last_rates[k]
        turn = rotations[k] * _turn(h)
        spin = turn * _spin(h, rate)
    pose[0] = place
    for i in range(3):
        pose[1 + i] = wp.vec3d(turn[i, 0], turn[i, 1], turn[i, 2])
    pose[4] = velocity
    pose[5] = spin


@wp.kernel(enable_backward=False)
def watch_nodes(
    reach: wp.array[wp.float64],
    x: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in, out
    seen: wp.array[wp.float64],
    travel: wp.array[wp.float64],
) -> None:
    """How far any contact point went at most since the last look [m], into the entry of this substep's parity.

    ``reach`` is what a node's way counts for (:func:`physworld.engine.terms.colliders.reach_of_nodes`). The entry of
    the next substep is emptied; one that was not emptied in time is too far, never too near.
    """
    node = 3 * wp.tid()
    parity = counter[1] % 2
    if node == 0:
        travel[1 - parity] = wp.float64(0.0)
    way = wp.vec3d(x[node] - seen[node], x[node + 1] - seen[node + 1], x[node + 2] - seen[node + 2])
    for i in range(3):
        seen[node + i] = x[node + i]
    wp.atomic_max(travel, parity, reach[wp.tid()] * wp.length(way))


@wp.func
def collider_distance(
    kind: int,
    size: wp.vec3d,
    values: wp.array3d[wp.float32],
    low: wp.vec3d,
    inverse: wp.vec3d,
    pose: wp.array[wp.vec3d],
    x: wp.vec3d,
) -> wp.vec4d:
    """Gradient in the world (no unit) and distance [m] of a collider at ``x``."""
    turn = wp.matrix_from_rows(pose[1], pose[2], pose[3])
    found = signed_distance(kind, size, values, low, inverse, wp.transpose(turn) * (x - pose[0]))
    n = turn * wp.vec3d(found[0], found[1], found[2])
    return wp.vec4d(n[0], n[1], n[2], found[3])


@wp.func
def collider_velocity(pose: wp.array[wp.vec3d], x: wp.vec3d) -> wp.vec3d:
    """Velocity of the collider's material at ``x`` [m/s]."""
    return pose[4] + wp.cross(pose[5], x - pose[0])


@wp.kernel
def touch_collider(
    # model: shape
    kind: int,
    size: wp.vec3d,
    values: wp.array3d[wp.float32],
    low: wp.vec3d,
    inverse: wp.vec3d,
    # model: contact points
    row_start: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    measure: wp.array[wp.float64],
    offset: wp.array[wp.float64],
    # model: normal and tangential stiffness [N/m per measure], dampings [N s/m per measure], Coulomb's coefficient
    stiffness: wp.float64,
    shear_stiffness: wp.float64,
    damping: wp.float64,
    shear_damping: wp.float64,
    friction: wp.float64,
    # in
    pose: wp.array[wp.vec3d],
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
    """Push one point of the body out of the collider, and hold it along the surface up to Coulomb's limit.

    ``stretch`` is the elastic slip of a point that sticks [m] (Cundall and Strack 1979). ``clearance`` is how far a
    point is away at least [m]: its distance when it was last looked at, less what the nodes can have moved it since.
    """
    point = wp.tid()
    zero = wp.float64(0.0)
    left = clearance[point] - travel[counter[1] % 2]
    if counter[0] == 0 and counter[1] == 0:  # whatever a run before left, even one that blew up
        left = zero
    clearance[point] = left
    if left > wp.static(wp.float64(ROUND_OFF_M)):
        return
    here = weighted_sum(x, columns, weights, row_start[point], row_start[point + 1])
    found = collider_distance(kind, size, values, low, inverse, pose, here)
    depth = offset[point] - found[3]
    clearance[point] = -depth
    if depth <= zero:
        stretch[point] = wp.vec3d()
        return
    along = wp.vec3d(found[0], found[1], found[2])
    normal = wp.normalize(along)
    slide = weighted_sum(v, columns, weights, row_start[point], row_start[point + 1])
    slide -= collider_velocity(pose, here)
    approach = wp.dot(slide, along)
    slide -= wp.dot(slide, normal) * normal
    pressure = wp.max(stiffness * depth - damping * approach, zero) * measure[point]
    push = pressure * along
    if friction > zero:
        slip = wp.vec3d()
        if counter[0] > 0 or counter[1] > 0:
            slip = stretch[point]
        slip += clock[2] * slide
        slip -= wp.dot(slip, normal) * normal
        drag = measure[point] * (shear_stiffness * slip + shear_damping * slide)
        size_of_drag = wp.length(drag)
        limit = friction * pressure
        if size_of_drag > limit:
            drag *= limit / size_of_drag
            longest = limit / (measure[point] * shear_stiffness)
            length = wp.length(slip)
            if length > longest:
                slip *= longest / length
        stretch[point] = slip
        push -= drag
    for k in range(row_start[point], row_start[point + 1]):
        node = 3 * columns[k]
        for i in range(3):
            wp.atomic_add(force, node + i, weights[k] * push[i])
    for i in range(3):
        wp.atomic_add(totals, i, clock[2] * push[i])
    wp.atomic_max(totals, 3, depth)
