"""Device side of a rope's middle line and a sheet's middle surface: places on them, and the nearest places.

    sheet    min over r of |x(q_i) - x(r)|^2
    rope     min over q, r of |x(q) - x(r)|^2 + e |x'|^2 (q - q_i)^2 + f |x'|^2 (r - q_j)^2

with q and r within W of q_i and q_j. e and f are small where two strands cross, so that their shortest way counts, and
hold the points at their own places along directions in which the distance does not tell: strands side by side, and a
strand that bends around another. Minima are found by Newton's method without the curvatures that would turn it back: it
goes downhill. Places are in cells from the lattice's lowest corner; a rope's second coordinate is 1/2.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

WINDOW = wp.constant(wp.float64(1.0))  # W: cells along a rope on either side of a point in which it acts
_WEAK = wp.constant(wp.float64(0.005))  # e of straight strands
_WEAKER = wp.constant(wp.float64(0.0005))  # f
_HALF = wp.constant(wp.float64(0.5))


@wp.struct
class Body:
    """The body's middle line or surface."""

    dim: int
    cell_nodes: wp.array[wp.int32]
    table: wp.array[wp.int32]  # cell at every place of the lattice's box, -1 for none
    counts: wp.vec2i  # of that box
    low: wp.vec2d  # where material begins and ends [cells]
    high: wp.vec2d
    spacing: wp.vec2d  # [m]
    thickness: wp.float64  # distance at which it touches itself [m]
    skin: wp.float64  # [m]
    apart: wp.float64  # nearer along the body no two places touch [m]


@wp.struct
class Place:
    """A place of the body: its cell (-1: none), its coordinates in it, and what is known there."""

    cell: int
    u: wp.vec2d
    x: wp.vec3d
    d1: wp.vec3d
    d2: wp.vec3d
    d11: wp.vec3d
    d22: wp.vec3d


@wp.func
def cell_at(body: Body, q: wp.vec2d) -> tuple[int, wp.vec2d]:
    i = wp.clamp(int(q[0]), 0, body.counts[0] - 1)
    j = wp.clamp(int(q[1]), 0, body.counts[1] - 1)
    return body.table[i * body.counts[1] + j], wp.vec2d(q[0] - wp.float64(i), q[1] - wp.float64(j))


@wp.func
def _weights(u: wp.float64) -> wp.vec3d:
    return wp.vec3d(_HALF * (wp.float64(1.0) - u) * (wp.float64(1.0) - u), _HALF + u - u * u, _HALF * u * u)


@wp.func
def _slopes(u: wp.float64) -> wp.vec3d:
    return wp.vec3d(u - wp.float64(1.0), wp.float64(1.0) - wp.float64(2.0) * u, u)


@wp.func
def node_at(values: wp.array[wp.float64], node: int) -> wp.vec3d:
    return wp.vec3d(values[3 * node], values[3 * node + 1], values[3 * node + 2])


@wp.func
def value_at(body: Body, values: wp.array[wp.float64], cell: int, u: wp.vec2d) -> wp.vec3d:
    """What nodal vectors ``values`` (3n,) are at a place."""
    a = _weights(u[0])
    found = wp.vec3d()
    if body.dim == 1:
        for i in range(3):
            found += a[i] * node_at(values, body.cell_nodes[3 * cell + i])
    else:
        b = _weights(u[1])
        for i in range(3):
            for j in range(3):
                found += a[i] * b[j] * node_at(values, body.cell_nodes[9 * cell + 3 * i + j])
    return found


@wp.func
def add_at(body: Body, values: wp.array[wp.float64], cell: int, u: wp.vec2d, vector: wp.vec3d) -> None:
    """Spread a vector at a place over its nodes."""
    a = _weights(u[0])
    b = _weights(u[1])
    width = 3
    if body.dim == 1:
        width = 1
        b = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    for i in range(3):
        for j in range(width):
            node = body.cell_nodes[3 * width * cell + width * i + j]
            for k in range(3):
                wp.atomic_add(values, 3 * node + k, a[i] * b[j] * vector[k])


@wp.func
def share_at(body: Body, mask: wp.array[wp.float64], cell: int, u: wp.vec2d) -> wp.float64:
    """A nodal number at a place."""
    a = _weights(u[0])
    b = _weights(u[1])
    width = 3
    if body.dim == 1:
        width = 1
        b = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    found = wp.float64(0.0)
    for i in range(3):
        for j in range(width):
            found += a[i] * b[j] * mask[body.cell_nodes[3 * width * cell + width * i + j]]
    return found


@wp.func
def place_at(body: Body, x: wp.array[wp.float64], q: wp.vec2d) -> Place:
    """Position and its derivatives [m, m per cell] at a place."""
    here = Place()
    cell, u = cell_at(body, q)
    here.cell = cell
    here.u = u
    if cell < 0:
        return here
    a = _weights(u[0])
    da = _slopes(u[0])
    if body.dim == 1:
        for i in range(3):
            p = node_at(x, body.cell_nodes[3 * cell + i])
            here.x += a[i] * p
            here.d1 += da[i] * p
            c = wp.float64(1.0)
            if i == 1:
                c = wp.float64(-2.0)
            here.d11 += c * p
        return here
    b = _weights(u[1])
    db = _slopes(u[1])
    for i in range(3):
        row = wp.vec3d()
        row_d = wp.vec3d()
        row_dd = wp.vec3d()
        for j in range(3):
            p = node_at(x, body.cell_nodes[9 * cell + 3 * i + j])
            row += b[j] * p
            row_d += db[j] * p
            c = wp.float64(1.0)
            if j == 1:
                c = wp.float64(-2.0)
            row_dd += c * p
        c = wp.float64(1.0)
        if i == 1:
            c = wp.float64(-2.0)
        here.x += a[i] * row
        here.d1 += da[i] * row
        here.d2 += a[i] * row_d
        here.d11 += c * row
        here.d22 += a[i] * row_dd
    return here


@wp.func
def _bounded(step: wp.float64) -> wp.float64:
    return wp.clamp(step, -_HALF, _HALF)


@wp.func
def _in_window(body: Body, middle: wp.float64, q: wp.float64) -> wp.float64:
    return wp.clamp(q, wp.max(middle - WINDOW, body.low[0]), wp.min(middle + WINDOW, body.high[0]))


@wp.func
def _step_of_sheet(body: Body, x: wp.array[wp.float64], here: wp.vec3d, r: wp.vec2d) -> wp.vec2d:
    """One step towards the place nearest to ``here``."""
    zero = wp.float64(0.0)
    there = place_at(body, x, r)
    d = here - there.x
    h11 = wp.dot(there.d1, there.d1) + wp.max(zero, -wp.dot(d, there.d11))
    h22 = wp.dot(there.d2, there.d2) + wp.max(zero, -wp.dot(d, there.d22))
    h12 = wp.dot(there.d1, there.d2)
    g1 = wp.dot(d, there.d1)
    g2 = wp.dot(d, there.d2)
    det = h11 * h22 - h12 * h12
    if det <= wp.float64(1.0e-12) * h11 * h22:
        return r
    first = wp.clamp(r[0] + _bounded((h22 * g1 - h12 * g2) / det), body.low[0], body.high[0])
    second = wp.clamp(r[1] + _bounded((g2 - h12 * (first - r[0])) / h22), body.low[1], body.high[1])
    first = wp.clamp(r[0] + _bounded((g1 - h12 * (second - r[1])) / h11), body.low[0], body.high[0])
    moved = wp.vec2d(first, second)
    cell, _u = cell_at(body, moved)
    if cell < 0:
        return r
    return moved


@wp.func
def _step_of_rope(
    body: Body, x: wp.array[wp.float64], middles: wp.vec2d, q: wp.float64, r: wp.float64
) -> wp.vec2d:
    """One step towards the shortest way between the windows around two points of a rope."""
    zero = wp.float64(0.0)
    here = place_at(body, x, wp.vec2d(q, _HALF))
    there = place_at(body, x, wp.vec2d(r, _HALF))
    d = here.x - there.x
    first_size = wp.dot(here.d1, here.d1)
    second_size = wp.dot(there.d1, there.d1)
    first_bend = wp.dot(d, here.d11)
    second_bend = -wp.dot(d, there.d11)
    h11 = first_size * (wp.float64(1.0) + _WEAK) + wp.max(zero, first_bend)
    h22 = second_size * (wp.float64(1.0) + _WEAKER) + wp.max(zero, second_bend)
    h12 = -wp.dot(here.d1, there.d1)
    g1 = wp.dot(d, here.d1) + (_WEAK * first_size + wp.max(zero, -first_bend)) * (q - middles[0])
    g2 = -wp.dot(d, there.d1) + (_WEAKER * second_size + wp.max(zero, -second_bend)) * (r - middles[1])
    det = h11 * h22 - h12 * h12
    if det <= wp.float64(1.0e-12) * h11 * h22:
        return wp.vec2d(q, r)
    own = _in_window(body, middles[0], q + _bounded((h12 * g2 - h22 * g1) / det))
    other = _in_window(body, middles[1], r + _bounded((-g2 - h12 * (own - q)) / h22))
    own = _in_window(body, middles[0], q + _bounded((-g1 - h12 * (other - r)) / h11))
    own_cell, _u = cell_at(body, wp.vec2d(own, _HALF))
    other_cell, _u = cell_at(body, wp.vec2d(other, _HALF))
    if own_cell < 0:
        own = q
    if other_cell < 0:
        other = r
    return wp.vec2d(own, other)


@wp.func
def refined(
    body: Body,
    x: wp.array[wp.float64],
    middles: wp.vec2d,
    own: wp.vec2d,
    other: wp.vec2d,
    steps: int,
) -> tuple[wp.vec2d, wp.vec2d]:
    """Places of a pair after some steps; ``middles`` are those of a rope's windows."""
    q = own
    r = other
    if body.dim == 1:
        for _step in range(steps):
            pair = _step_of_rope(body, x, middles, q[0], r[0])
            q = wp.vec2d(pair[0], _HALF)
            r = wp.vec2d(pair[1], _HALF)
    else:
        cell, u = cell_at(body, own)
        here = value_at(body, x, cell, u)
        for _step in range(steps):
            r = _step_of_sheet(body, x, here, r)
    return q, r
