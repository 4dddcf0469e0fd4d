"""Device side of contact in updated Lagrangian MPM: impulses between the particles at a collider and the grid.

A particle touches with its face, g dx before its middle (g the Gauss point's distance from a cell's face). On the
grid's velocity after all other forces, every particle p near a collider asks for

    u_p = sum_i w_ip v_i        (u_p - v_c) . n  >=  -gap / dt            gap open: it may come up to the surface
                                                 >=  beta depth / dt      gap closed: what is inside leaves slowly

and gets it by an impulse J_p = J_n n + J_t at the particle, v_i += w_ip J_p / m_i, with J_n >= 0 and |J_t| <= mu J_n:
the projected Gauss-Seidel method (Jean and Moreau 1992; Catto 2005), warm-started with the impulses of the last
substep. J_n is never negative, so nothing is held back; J_t stops what slides as long as Coulomb's cone lets it. On a
CPU the particles take their turns, on CUDA they act at once with a relaxation.

Legend: w weights; pose, clock, counter, totals: :mod:`physworld.engine.terms.colliders_kernels`; box = first cell (3),
nodes (3), rim; velocity = (velocity [m/s], inverse mass [1/kg], 0 where a grip prescribes) of a node; contact =
(normal, least normal velocity against the collider [m/s]); drive = the collider's velocity [m/s]; near = (how many
particles are near the collider) then their numbers.
"""

from __future__ import annotations

import warp as wp

from physworld.engine.terms.colliders_kernels import collider_velocity
from physworld.shapes.sdf_kernels import SAMPLED, signed_distance

_SAMPLED = wp.constant(SAMPLED)
_INSIDE = wp.constant(wp.float64(1.0e-6))  # of a sample's spacing


@wp.struct
class Stencil:
    """The 27 nodes that a particle sees: node of the lowest corner in the box, weights an axis (rows)."""

    i: int
    j: int
    k: int
    weights: wp.mat33f


@wp.func
def stencil_of(x: wp.vec3d, origin: wp.vec3d, inv_dx: wp.vec3d, box: wp.array[wp.int32]) -> Stencil:
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
def inside(s: Stencil, box: wp.array[wp.int32]) -> bool:
    """Whether all 27 nodes exist."""
    return s.i >= 0 and s.j >= 0 and s.k >= 0 and s.i + 2 < box[3] and s.j + 2 < box[4] and s.k + 2 < box[5]


@wp.func
def distance_from(
    kind: int,
    size: wp.vec3d,
    values: wp.array3d[wp.float32],
    low: wp.vec3d,
    inverse: wp.vec3d,
    pose: wp.array[wp.vec3d],
    x: wp.vec3d,
) -> wp.vec4d:
    """Outward normal in the world and distance [m] of a collider at ``x``.

    Beyond the samples of a mesh, which end close to it, a point is as far as from what its nearest sample is next to.
    """
    turn = wp.matrix_from_rows(pose[1], pose[2], pose[3])
    local = wp.transpose(turn) * (x - pose[0])
    sampled = local
    if kind == _SAMPLED:
        for i in range(3):
            last = low[i] + (wp.float64(values.shape[i] - 1) - _INSIDE) / inverse[i]
            sampled[i] = wp.clamp(local[i], low[i] + _INSIDE / inverse[i], last)
    found = signed_distance(kind, size, values, low, inverse, sampled)
    n = wp.normalize(wp.vec3d(found[0], found[1], found[2]))
    distance = found[3]
    beyond = local - sampled
    if wp.dot(beyond, beyond) > wp.float64(0.0):
        beyond += distance * n
        distance = wp.length(beyond)
        n = beyond / distance
    n = turn * n
    return wp.vec4d(n[0], n[1], n[2], distance)


_CARRIED = r"""
    const float* grid = (const float*)velocity.data;
    const int n1 = box.data[4], n2 = box.data[5];
    wp::vec_t<4, float> out;
#if defined(__CUDA_ARCH__)
    float total[4] = {0.0f, 0.0f, 0.0f, 0.0f};
#else
    typedef float V4 __attribute__((vector_size(16), aligned(4)));
    V4 total = V4{};
#endif
    float mobility = 0.0f;
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) {
            const float* row = grid + 4 * (((i + a) * n1 + j + b) * n2 + k);
            const float plane = weights.data[0][a] * weights.data[1][b];
            for (int c = 0; c < 3; ++c) {
                const float w = plane * weights.data[2][c];
                mobility += w * w * row[4 * c + 3];
#if defined(__CUDA_ARCH__)
                for (int q = 0; q < 3; ++q) total[q] += w * row[4 * c + q];
#else
                total += w * *(const V4*)(row + 4 * c);
#endif
            }
        }
    for (int q = 0; q < 3; ++q) out[q] = total[q];
    out[3] = mobility;
    return out;
"""

_PUSH = r"""
    float* grid = (float*)velocity.data;
    const int n1 = box.data[4], n2 = box.data[5];
#if !defined(__CUDA_ARCH__)
    typedef float V4 __attribute__((vector_size(16), aligned(4)));
    const V4 given = V4{impulse[0], impulse[1], impulse[2], 0.0f};
#endif
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) {
            float* row = grid + 4 * (((i + a) * n1 + j + b) * n2 + k);
            const float plane = weights.data[0][a] * weights.data[1][b];
            for (int c = 0; c < 3; ++c) {
                const float share = plane * weights.data[2][c] * row[4 * c + 3];
#if defined(__CUDA_ARCH__)
                for (int q = 0; q < 3; ++q) atomicAdd(row + 4 * c + q, share * impulse[q]);
#else
                *(V4*)(row + 4 * c) = *(V4*)(row + 4 * c) + share * given;
#endif
            }
        }
"""


@wp.func_native(_CARRIED)
def carried(
    i: int,
    j: int,
    k: int,
    weights: wp.mat33f,
    box: wp.array[wp.int32],
    velocity: wp.array[wp.vec4f],
) -> wp.vec4f:
    """Grid velocity at a particle [m/s], and what an impulse of 1 N s there adds to it [1/kg]."""


@wp.func_native(_PUSH)
def push(
    i: int, j: int, k: int, weights: wp.mat33f, box: wp.array[wp.int32], impulse: wp.vec3f,
    velocity: wp.array[wp.vec4f],
) -> None:  # fmt: skip
    """Give an impulse [N s] at a particle to its nodes."""


_SIFT = r"""
    const double* place = (const double*)pose.data;   // position, then the three rows of the rotation
    const double nx = place[5], ny = place[8], nz = place[11];
    for (int p = group * batch; p < group * (batch + 1) && p < count; ++p) {
        const double a = x.data[3 * p] - place[0], b = x.data[3 * p + 1] - place[1], c = x.data[3 * p + 2] - place[2];
        const bool far = plane ? a * nx + b * ny + c * nz > reach : a * a + b * b + c * c > reach * reach;
        if (far) continue;
#if defined(__CUDA_ARCH__)
        candidates.data[1 + atomicAdd(&candidates.data[0], 1)] = p;
#else
        candidates.data[1 + candidates.data[0]++] = p;
#endif
    }
"""


@wp.func_native(_SIFT)
def _sift(
    batch: int,
    group: int,
    count: int,
    plane: int,
    reach: wp.float64,
    pose: wp.array[wp.vec3d],
    x: wp.array[wp.float64],
    candidates: wp.array[wp.int32],
) -> None: ...


@wp.kernel(enable_backward=False)
def sift(
    group: int,
    count: int,
    # model
    plane: int,
    reach: wp.float64,
    # in
    pose: wp.array[wp.vec3d],
    x: wp.array[wp.float64],
    # out
    candidates: wp.array[wp.int32],
) -> None:
    """List those of ``group`` particles that may be near: within ``reach`` [m] of the frame, or over a ``plane``."""
    _sift(wp.tid(), group, count, plane, reach, pose, x, candidates)


@wp.kernel(enable_backward=False)
def forget_near(candidates: wp.array[wp.int32], near: wp.array[wp.int32], turn: wp.array[wp.int32]) -> None:
    """No particle is near any more: a new turn."""
    candidates[0] = 0
    near[0] = 0
    turn[0] = turn[0] + 1


@wp.kernel(enable_backward=False)
def find_near(
    stride: int,
    # model: shape
    kind: int,
    size: wp.vec3d,
    values: wp.array3d[wp.float32],
    low: wp.vec3d,
    inverse: wp.vec3d,
    # model: half a particle an axis, depths at the start
    half: wp.vec3d,
    relief: wp.array[wp.float64],
    sight: wp.float64,
    leaving: wp.float64,
    fastest: wp.float64,
    clock: wp.array[wp.float64],
    turn: wp.array[wp.int32],
    # in
    pose: wp.array[wp.vec3d],
    x: wp.array[wp.float64],
    candidates: wp.array[wp.int32],
    # in, out
    last: wp.array[wp.int32],
    # out
    near: wp.array[wp.int32],
    contact: wp.array[wp.vec4f],
    drive: wp.array[wp.vec3f],
    impulse: wp.array[wp.vec3f],
    totals: wp.array[wp.float64],
) -> None:
    """List every ``stride``-th candidate whose face is within ``sight`` [m] of the collider, with what it asks for.

    What is inside leaves at ``leaving`` of its depth a substep, at most at ``fastest`` dx / dt [m]. ``last`` is the
    turn in which a particle was near: an impulse is remembered for one turn.
    """
    for c in range(wp.tid(), candidates[0], stride):
        p = candidates[1 + c]
        here = wp.vec3d(x[3 * p], x[3 * p + 1], x[3 * p + 2])
        found = distance_from(kind, size, values, low, inverse, pose, here)
        n = wp.vec3d(found[0], found[1], found[2])
        gap = found[3] - relief[p] - wp.length(wp.cw_mul(n, half))
        if gap <= sight:
            if last[p] + 1 < turn[0]:
                impulse[p] = wp.vec3f()
            last[p] = turn[0]
            least = -gap * clock[1]
            if gap < wp.float64(0.0):
                least = wp.min(leaving * least, fastest * clock[1])
                wp.atomic_max(totals, 3, -gap)
            wall = collider_velocity(pose, here)
            near[1 + wp.atomic_add(near, 0, 1)] = p
            contact[p] = wp.vec4f(wp.float32(n[0]), wp.float32(n[1]), wp.float32(n[2]), wp.float32(least))
            drive[p] = wp.vec3f(wp.float32(wall[0]), wp.float32(wall[1]), wp.float32(wall[2]))


@wp.func
def correct(
    p: int,
    # model
    friction: wp.array[wp.float32],
    relaxation: float,
    again: int,
    origin: wp.vec3d,
    inv_dx: wp.vec3d,
    box: wp.array[wp.int32],
    # in
    x: wp.array[wp.float64],
    contact: wp.array[wp.vec4f],
    drive: wp.array[wp.vec3f],
    seen: wp.array[wp.vec4f],
    # in, out
    impulse: wp.array[wp.vec3f],
    velocity: wp.array[wp.vec4f],
    totals: wp.array[wp.float64],
    hardest: wp.array[wp.float32],
) -> None:
    """Correct the impulse [N s] of one particle; see :func:`press`."""
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
        now = carried(s.i, s.j, s.k, s.weights, box, seen)
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
    push(s.i, s.j, s.k, s.weights, box, change, velocity)
    for i in range(3):
        wp.atomic_add(totals, i, wp.float64(change[i]))


@wp.kernel(enable_backward=False)
def press(
    stride: int,
    # model
    friction: wp.array[wp.float32],
    relaxation: float,
    again: int,
    origin: wp.vec3d,
    inv_dx: wp.vec3d,
    box: wp.array[wp.int32],
    # in
    x: wp.array[wp.float64],
    near: wp.array[wp.int32],
    contact: wp.array[wp.vec4f],
    drive: wp.array[wp.vec3f],
    seen: wp.array[wp.vec4f],
    # in, out
    impulse: wp.array[wp.vec3f],
    velocity: wp.array[wp.vec4f],
    totals: wp.array[wp.float64],
    hardest: wp.array[wp.float32],
) -> None:
    """Correct the impulses [N s] of every ``stride``-th near particle; with ``again`` give them the last substep's.

    ``seen`` is ``velocity`` itself where particles take their turns, a copy where they act at once; ``hardest`` becomes
    the greatest normal impulse.
    """
    for c in range(wp.tid(), near[0], stride):
        correct(
            near[1 + c], friction, relaxation, again, origin, inv_dx, box, x, contact, drive, seen, impulse, velocity,
            totals, hardest,
        )  # fmt: skip
