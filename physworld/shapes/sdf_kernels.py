"""Device side of signed distances: closed forms of the primitives, trilinear samples of everything else.

A shape on the device is (kind, size, values, low, inverse spacing); ``size`` is

    SPHERE (radius, -, -) · BOX half sides · CAPSULE, CYLINDER (radius, half length, -), axis z · HALF_SPACE (z <= 0)

and ``values`` the samples of a grid (kind SAMPLED). Distances are negative inside [m].
"""

from __future__ import annotations

import warp as wp

SPHERE, BOX, CAPSULE, CYLINDER, HALF_SPACE, SAMPLED = range(6)
FAR_M = 1.0e6  # what lies outside of a grid is this far away

_SPHERE = wp.constant(SPHERE)
_BOX = wp.constant(BOX)
_CAPSULE = wp.constant(CAPSULE)
_CYLINDER = wp.constant(CYLINDER)
_HALF_SPACE = wp.constant(HALF_SPACE)
_FAR = wp.constant(wp.float64(FAR_M))


@wp.func
def _ball(p: wp.vec3d, radius: wp.float64) -> wp.vec4d:
    length = wp.length(p)
    if length < wp.float64(1.0e-30):
        return wp.vec4d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0), -radius)
    n = p / length
    return wp.vec4d(n[0], n[1], n[2], length - radius)


@wp.func
def _sign(value: wp.float64) -> wp.float64:
    if value < wp.float64(0.0):
        return wp.float64(-1.0)
    return wp.float64(1.0)


@wp.func
def _corner(p: wp.vec3d, half: wp.vec3d) -> wp.vec4d:
    """Box of half sides ``half``."""
    q = wp.vec3d(wp.abs(p[0]) - half[0], wp.abs(p[1]) - half[1], wp.abs(p[2]) - half[2])
    zero = wp.float64(0.0)
    if q[0] > zero or q[1] > zero or q[2] > zero:
        out = wp.vec3d(wp.max(q[0], zero), wp.max(q[1], zero), wp.max(q[2], zero))
        length = wp.length(out)
        return wp.vec4d(
            _sign(p[0]) * out[0] / length,
            _sign(p[1]) * out[1] / length,
            _sign(p[2]) * out[2] / length,
            length,
        )
    if q[0] >= q[1] and q[0] >= q[2]:
        return wp.vec4d(_sign(p[0]), zero, zero, q[0])
    if q[1] >= q[2]:
        return wp.vec4d(zero, _sign(p[1]), zero, q[1])
    return wp.vec4d(zero, zero, _sign(p[2]), q[2])


@wp.func
def _disc(p: wp.vec3d, radius: wp.float64, half_length: wp.float64) -> wp.vec4d:
    """Cylinder: a rectangle in the half plane of the distance from the axis and the height."""
    r = wp.sqrt(p[0] * p[0] + p[1] * p[1])
    flat = _corner(wp.vec3d(r, p[2], wp.float64(0.0)), wp.vec3d(radius, half_length, wp.float64(1.0e30)))
    across = wp.max(r, wp.float64(1.0e-30))
    return wp.vec4d(flat[0] * p[0] / across, flat[0] * p[1] / across, flat[1], flat[3])


@wp.func
def _trilinear(values: wp.array3d[wp.float32], low: wp.vec3d, inverse: wp.vec3d, p: wp.vec3d) -> wp.vec4d:
    """Interpolant and its exact gradient."""
    t = wp.cw_mul(p - low, inverse)
    i = int(wp.floor(t[0]))
    j = int(wp.floor(t[1]))
    k = int(wp.floor(t[2]))
    zero, one = wp.float64(0.0), wp.float64(1.0)
    if (
        i < 0
        or j < 0
        or k < 0
        or i + 1 >= values.shape[0]
        or j + 1 >= values.shape[1]
        or k + 1 >= values.shape[2]
    ):
        return wp.vec4d(zero, zero, one, _FAR)
    u = t[0] - wp.float64(i)
    v = t[1] - wp.float64(j)
    w = t[2] - wp.float64(k)
    result = wp.vec4d()
    for a in range(2):
        x = wp.where(a == 0, one - u, u)
        dx = wp.where(a == 0, -inverse[0], inverse[0])
        for b in range(2):
            y = wp.where(b == 0, one - v, v)
            dy = wp.where(b == 0, -inverse[1], inverse[1])
            for c in range(2):
                z = wp.where(c == 0, one - w, w)
                dz = wp.where(c == 0, -inverse[2], inverse[2])
                value = wp.float64(values[i + a, j + b, k + c])
                result += value * wp.vec4d(dx * y * z, x * dy * z, x * y * dz, x * y * z)
    return result


@wp.func
def signed_distance(
    kind: int,
    size: wp.vec3d,
    values: wp.array3d[wp.float32],
    low: wp.vec3d,
    inverse: wp.vec3d,
    p: wp.vec3d,
) -> wp.vec4d:
    """Gradient (no unit) and distance [m] at ``p`` in the shape's own frame."""
    if kind == _SPHERE:
        return _ball(p, size[0])
    if kind == _BOX:
        return _corner(p, size)
    if kind == _CAPSULE:
        along = wp.clamp(p[2], -size[1], size[1])
        return _ball(p - wp.vec3d(wp.float64(0.0), wp.float64(0.0), along), size[0])
    if kind == _CYLINDER:
        return _disc(p, size[0], size[1])
    if kind == _HALF_SPACE:
        return wp.vec4d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0), p[2])
    return _trilinear(values, low, inverse, p)


@wp.kernel
def sample_mesh(mesh: wp.uint64, low: wp.vec3f, spacing: wp.float32, values: wp.array3d[wp.float32]) -> None:
    """Signed distance of every grid point to a closed mesh; the sign by a vote of three rays."""
    i, j, k = wp.tid()
    p = low + spacing * wp.vec3f(wp.float32(i), wp.float32(j), wp.float32(k))
    found = wp.mesh_query_point(mesh, p, 1.0e10)
    nearest = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    values[i, j, k] = found.sign * wp.length(p - nearest)


@wp.kernel
def evaluate(
    kind: int,
    size: wp.vec3d,
    values: wp.array3d[wp.float32],
    low: wp.vec3d,
    inverse: wp.vec3d,
    points: wp.array[wp.vec3d],
    # out
    found: wp.array[wp.vec4d],
) -> None:
    """Gradient and distance at many points."""
    m = wp.tid()
    found[m] = signed_distance(kind, size, values, low, inverse, points[m])
