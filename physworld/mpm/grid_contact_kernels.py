"""Device side of contact in updated Lagrangian MPM: impulses between the particles at a collider and the grid.

A particle touches with its face, g dx before its middle (g the Gauss point's distance from a cell's face). On the
grid's velocity after all other forces, every particle p near a collider asks for

    u_p = sum_i w_ip v_i        (u_p - v_c) . n  >=  -gap / dt            gap open: it may come up to the surface
                                                 >=  beta depth / dt      gap closed: what is inside leaves slowly

and gets it by an impulse J_p = J_n n + J_t at the particle, v_i += w_ip J_p / m_i, with J_n >= 0 and |J_t| <= mu J_n:
the projected Gauss-Seidel method (Jean and Moreau 1992; Catto 2005), warm-started with the impulses of the last
substep. J_n is never negative, so nothing is held back; J_t stops what slides as long as Coulomb's cone lets it. On a
CPU the particles take their turns, on CUDA they act at once with a relaxation.

Legend: w weights; pose, clock, counter, totals: :mod:`physworld.mpm.colliders_kernels`; box = first cell (3), nodes
(3), rim; velocity = (velocity [m/s], inverse mass [1/kg], 0 where a grip prescribes) of a node; contact = (normal,
least normal velocity against the collider [m/s]); drive = the collider's velocity [m/s]; near = (how many particles are
near the collider) then their numbers.
"""

from __future__ import annotations

import warp as wp

from physworld.mpm.colliders_kernels import collider_distance, collider_velocity


@wp.struct
class Stencil:
    """The 27 nodes that a particle sees: node of the lowest corner in the box, weights an axis (rows)."""

    i: int
    j: int
    k: int
    weights: wp.mat33f


@wp.func
def stencil_of(x: wp.vec3d, origin: wp.vec3d, inv_dx: wp.vec3d, box: wp.array(dtype=wp.int32)) -> Stencil:
    """Nodes and weights of a particle at ``x``; the corner is negative or too high where it left the box."""
    s = Stencil()
    scaled = wp.cw_mul(x - origin, inv_dx)
    cell = wp.vec3d(wp.floor(scaled[0]), wp.floor(scaled[1]), wp.floor(scaled[2]))
    s.i = int(cell[0]) - 1 - box[0]
    s.j = int(cell[1]) - 1 - box[1]
    s.k = int(cell[2]) - 1 - box[2]
    for axis in range(3):
        t = wp.float32(scaled[axis] - cell[axis])
        s.weights[axis, 0] = 0.5 * (1.0 - t) * (1.0 - t)
        s.weights[axis, 1] = 0.5 + t - t * t
        s.weights[axis, 2] = 0.5 * t * t
    return s


@wp.func
def inside(s: Stencil, box: wp.array(dtype=wp.int32)) -> bool:
    """Whether all 27 nodes exist."""
    return s.i >= 0 and s.j >= 0 and s.k >= 0 and s.i + 2 < box[3] and s.j + 2 < box[4] and s.k + 2 < box[5]


@wp.func
def carried(s: Stencil, box: wp.array(dtype=wp.int32), velocity: wp.array(dtype=wp.vec4f)) -> wp.vec4f:
    """Grid velocity at the particle [m/s], and what an impulse of 1 N s there adds to it [1/kg]."""
    total = wp.vec4f()
    for a in range(3):
        for b in range(3):
            row = ((s.i + a) * box[4] + s.j + b) * box[5] + s.k
            plane = s.weights[0, a] * s.weights[1, b]
            for c in range(3):
                w = plane * s.weights[2, c]
                v = velocity[row + c]
                total += w * wp.vec4f(v[0], v[1], v[2], w * v[3])
    return total


@wp.func
def push(s: Stencil, box: wp.array(dtype=wp.int32), impulse: wp.vec3f, velocity: wp.array(dtype=wp.vec4f)):
    """Give an impulse [N s] at the particle to its nodes."""
    for a in range(3):
        for b in range(3):
            row = ((s.i + a) * box[4] + s.j + b) * box[5] + s.k
            plane = s.weights[0, a] * s.weights[1, b]
            for c in range(3):
                share = plane * s.weights[2, c] * velocity[row + c][3]
                wp.atomic_add(
                    velocity,
                    row + c,
                    wp.vec4f(share * impulse[0], share * impulse[1], share * impulse[2], 0.0),
                )


@wp.kernel(enable_backward=False)
def forget_near(near: wp.array(dtype=wp.int32)):
    """No particle is near any more."""
    near[0] = 0


@wp.kernel(enable_backward=False)
def find_near(
    # model: shape
    kind: int,
    size: wp.vec3d,
    values: wp.array3d(dtype=wp.float32),
    low: wp.vec3d,
    inverse: wp.vec3d,
    # model: distance of the shape's farthest point from its frame, half a particle an axis, depths at the start, 1
    reach: wp.float64,
    half: wp.vec3d,
    relief: wp.array(dtype=wp.float64),
    sight: wp.float64,
    leaving: wp.float64,
    fastest: wp.float64,
    clock: wp.array(dtype=wp.float64),
    # in
    pose: wp.array(dtype=wp.vec3d),
    x: wp.array(dtype=wp.float64),
    # out
    near: wp.array(dtype=wp.int32),
    contact: wp.array(dtype=wp.vec4f),
    drive: wp.array(dtype=wp.vec3f),
    impulse: wp.array(dtype=wp.vec3f),
    totals: wp.array(dtype=wp.float64),
):
    """List one particle if its face is within ``sight`` [m] of the collider, with what it asks for.

    What is inside leaves at ``leaving`` of its depth a substep, at most at ``fastest`` dx / dt [m].
    """
    p = wp.tid()
    here = wp.vec3d(x[3 * p], x[3 * p + 1], x[3 * p + 2])
    if wp.length(here - pose[0]) > reach:
        impulse[p] = wp.vec3f()
        return
    found = collider_distance(kind, size, values, low, inverse, pose, here)
    n = wp.normalize(wp.vec3d(found[0], found[1], found[2]))
    gap = found[3] - relief[p] - wp.length(wp.cw_mul(n, half))
    if gap > sight:
        impulse[p] = wp.vec3f()
        return
    least = -gap * clock[1]
    if gap < wp.float64(0.0):
        least = wp.min(leaving * least, fastest * clock[1])
        wp.atomic_max(totals, 3, -gap)
    wall = collider_velocity(pose, here)
    near[1 + wp.atomic_add(near, 0, 1)] = p
    contact[p] = wp.vec4f(wp.float32(n[0]), wp.float32(n[1]), wp.float32(n[2]), wp.float32(least))
    drive[p] = wp.vec3f(wp.float32(wall[0]), wp.float32(wall[1]), wp.float32(wall[2]))


@wp.kernel(enable_backward=False)
def press(
    # model
    friction: wp.array(dtype=wp.float32),
    relaxation: float,
    again: int,
    origin: wp.vec3d,
    inv_dx: wp.vec3d,
    box: wp.array(dtype=wp.int32),
    # in
    x: wp.array(dtype=wp.float64),
    near: wp.array(dtype=wp.int32),
    contact: wp.array(dtype=wp.vec4f),
    drive: wp.array(dtype=wp.vec3f),
    seen: wp.array(dtype=wp.vec4f),
    # in, out
    impulse: wp.array(dtype=wp.vec3f),
    velocity: wp.array(dtype=wp.vec4f),
    totals: wp.array(dtype=wp.float64),
    hardest: wp.array(dtype=wp.float32),
):
    """Correct the impulse [N s] of one near particle; with ``again`` give it the last substep's, within its cone.

    ``seen`` is ``velocity`` itself where particles take their turns, a copy where they act at once; ``hardest`` becomes
    the greatest normal impulse.
    """
    turn = wp.tid()
    if turn >= near[0]:
        return
    p = near[1 + turn]
    s = stencil_of(wp.vec3d(x[3 * p], x[3 * p + 1], x[3 * p + 2]), origin, inv_dx, box)
    if not inside(s, box):
        impulse[p] = wp.vec3f()
        return
    n = wp.vec3f(contact[p][0], contact[p][1], contact[p][2])
    known = impulse[p]
    normal = wp.dot(known, n)
    along = known - normal * n
    given = wp.vec3f()
    if again == 0:
        now = carried(s, box, seen)
        if now[3] <= 0.0:
            return
        mass = relaxation / now[3]
        slide = wp.vec3f(now[0], now[1], now[2]) - drive[p]
        approach = wp.dot(slide, n)
        slide -= approach * n
        given = known
        normal += mass * (contact[p][3] - approach)
        along -= mass * slide
    normal = wp.max(normal, 0.0)
    size = wp.length(along)
    most = friction[p] * normal
    if size > most:
        along *= most / size
    wp.atomic_max(hardest, 0, normal)
    wanted = normal * n + along
    impulse[p] = wanted
    change = wanted - given
    push(s, box, change, velocity)
    for i in range(3):
        wp.atomic_add(totals, i, wp.float64(change[i]))
