"""Device side of self-contact: where a rope or a sheet comes near to itself, and what pushes it apart there.

A *contact point* i (its cell, its place q_i) looks for the nearest places r of the body's own middle line or surface
that are far from it along the body. Each such pair is kept in one of its slots and followed from substep to substep
(:mod:`physworld.mpm.self_contact_places`); the slots are sought anew, on a grid in space, after the body has moved by
half the skin. Of a rope, q moves too, and the point has the share 1 - |q - q_i| / W of what acts there: where two
strands cross the points beside it share one contact, where they lie side by side each has its own.

Slots: counts (S,), and K a point of places q and r, elastic slip [m], direction (unit) from r to q, and reach [m], the
distance at which it touches.

Legend: clock = (frame interval [s], 1/dt [1/s], dt [s]); counter = (frame, substep, substeps of this frame);
moved = (a node moved by half the skin, and so beside the middle node, searches so far).
"""

from __future__ import annotations

import warp as wp

from physworld.mpm.self_contact_places import (
    WINDOW,
    Body,
    add_at,
    cell_at,
    node_at,
    place_at,
    refined,
    share_at,
    value_at,
)

wp.set_module_options({"enable_backward": False})

NEIGHBOURS = wp.constant(8)  # slots a contact point
_FIRST_STEPS = wp.constant(8)  # of Newton's method from the middle of a cell
_STEPS = wp.constant(2)  # a substep, from where the last one ended
_HALF = wp.constant(wp.float64(0.5))
_BESIDE = wp.constant(
    wp.float64(0.25)
)  # cells by which a minimum may lie outside of the cell it was sought from


@wp.struct
class Points:
    """Its contact points."""

    cell: wp.array(dtype=wp.int32)
    place: wp.array(dtype=wp.vec2d)
    measure: wp.array(dtype=wp.float64)
    first: wp.array(dtype=wp.int32)  # of every cell, (C + 1,)


@wp.struct
class Slots:
    """Pairs that are near; see the module's text."""

    counts: wp.array(dtype=wp.int32)
    own: wp.array(dtype=wp.vec2d)
    other: wp.array(dtype=wp.vec2d)
    slip: wp.array(dtype=wp.vec3d)
    side: wp.array(dtype=wp.vec3d)
    reach: wp.array(dtype=wp.float64)
    active: wp.array(dtype=wp.int32)
    actives: wp.array(dtype=wp.int32)


@wp.func
def _along(body: Body, q: wp.vec2d, r: wp.vec2d):
    """Distance of two places in the undeformed body [m]."""
    return wp.length(wp.cw_mul(q - r, body.spacing))


@wp.func
def _bucket(p: wp.vec3d, width: wp.float64, i: int, j: int, k: int, mask: int):
    a = int(wp.floor(p[0] / width)) + i
    b = int(wp.floor(p[1] / width)) + j
    c = int(wp.floor(p[2] / width)) + k
    return ((a * 73856093) ^ (b * 19349663) ^ (c * 83492791)) & mask


@wp.kernel
def watch_nodes(
    # model
    middle: int,
    most: wp.float64,
    x: wp.array(dtype=wp.float64),
    built: wp.array(dtype=wp.float64),
    counter: wp.array(dtype=wp.int32),
    # in, out
    moved: wp.array(dtype=wp.int32),
):
    """Note whether a node moved farther than ``most`` [m^2, squared] since the last search."""
    node = wp.tid()
    if counter[0] == 0 and counter[1] == 0:
        moved[0] = 1
        moved[1] = 1
        if node == 0:
            moved[2] = 0
        return
    way = node_at(x, node) - node_at(built, node)
    if wp.dot(way, way) > most:
        moved[0] = 1
    way -= node_at(x, middle) - node_at(built, middle)
    if wp.dot(way, way) > most:
        moved[1] = 1


@wp.kernel
def clear_grid(
    lanes: int,
    counter: wp.array(dtype=wp.int32),
    moved: wp.array(dtype=wp.int32),
    # out
    heads: wp.array(dtype=wp.int32),
    slots: Slots,
    deepest: wp.array(dtype=wp.float64),
):
    """Empty the grid; a run's first substep forgets all pairs."""
    lane = wp.tid()
    if moved[0] == 0 or moved[1] == 0:
        return
    for k in range(lane, heads.shape[0], lanes):
        heads[k] = -1
    if lane == 0:
        slots.actives[0] = 0
    if counter[0] == 0 and counter[1] == 0:
        for k in range(lane, slots.counts.shape[0], lanes):
            slots.counts[k] = 0
        if lane == 0:
            deepest[0] = wp.float64(0.0)


@wp.kernel
def place_cells(
    lanes: int,
    body: Body,
    width: wp.float64,
    x: wp.array(dtype=wp.float64),
    moved: wp.array(dtype=wp.int32),
    # out
    centres: wp.array(dtype=wp.vec3d),
    heads: wp.array(dtype=wp.int32),
    nexts: wp.array(dtype=wp.int32),
):
    """Middles of the cells, and each in the list of its bucket of ``width`` [m]."""
    lane = wp.tid()
    if moved[0] == 0 or moved[1] == 0:
        return
    for cell in range(lane, centres.shape[0], lanes):
        centre = value_at(body, x, cell, wp.vec2d(_HALF, _HALF))
        centres[cell] = centre
        bucket = _bucket(centre, width, 0, 0, 0, heads.shape[0] - 1)
        nexts[cell] = wp.atomic_exch(heads, bucket, cell)


@wp.func
def _keep_slots(body: Body, points: Points, slots: Slots, x: wp.array(dtype=wp.float64), point: int):
    """Drop the pairs of a point that are no longer near."""
    kept = wp.int32(0)
    base = point * NEIGHBOURS
    for k in range(slots.counts[point]):
        a = base + k
        q, r = refined(body, x, points.place[point], slots.own[a], slots.other[a], _STEPS)
        distance = wp.length(place_at(body, x, q).x - place_at(body, x, r).x)
        if distance <= body.thickness + body.skin and _along(body, q, r) >= body.apart:
            b = base + kept
            slots.own[b] = q
            slots.other[b] = r
            slots.slip[b] = slots.slip[a]
            slots.side[b] = slots.side[a]
            slots.reach[b] = slots.reach[a]
            kept += 1
    slots.counts[point] = kept


@wp.func
def _seek(
    body: Body, points: Points, slots: Slots, x: wp.array(dtype=wp.float64), point: int, centre: wp.vec2d
):
    """Give a point the pair that is found from the middle of a cell, unless it has it."""
    own = points.place[point]
    q, r = refined(body, x, own, own, centre, _FIRST_STEPS)
    off = r - centre
    if wp.max(wp.abs(off[0]), wp.abs(off[1])) > _HALF + _BESIDE or _along(body, q, r) < body.apart:
        return
    way = place_at(body, x, q).x - place_at(body, x, r).x
    distance = wp.length(way)
    if distance > body.thickness + body.skin or distance <= wp.float64(0.0):
        return
    count = slots.counts[point]
    base = point * NEIGHBOURS
    for k in range(count):
        beside = slots.other[base + k] - r
        if wp.max(wp.abs(beside[0]), wp.abs(beside[1])) < _HALF:
            return
    if count == NEIGHBOURS:
        return
    slots.own[base + count] = q
    slots.other[base + count] = r
    slots.slip[base + count] = wp.vec3d()
    slots.side[base + count] = way / distance
    slots.reach[base + count] = wp.min(body.thickness, distance)
    slots.counts[point] = count + 1


@wp.kernel
def seek_pairs(
    lanes: int,
    body: Body,
    points: Points,
    width: wp.float64,
    around: wp.float64,
    cells: wp.array(dtype=wp.vec2i),
    x: wp.array(dtype=wp.float64),
    moved: wp.array(dtype=wp.int32),
    centres: wp.array(dtype=wp.vec3d),
    heads: wp.array(dtype=wp.int32),
    nexts: wp.array(dtype=wp.int32),
    # in, out
    slots: Slots,
):
    """Pairs of the points of every cell with what is near in space and far along the body.

    ``around``: how far from a cell's middle its material may be [m].
    """
    lane = wp.tid()
    if moved[0] == 0 or moved[1] == 0:
        return
    for cell in range(lane, centres.shape[0], lanes):
        begin = points.first[cell]
        end = points.first[cell + 1]
        for point in range(begin, end):
            _keep_slots(body, points, slots, x, point)
        here = centres[cell]
        mine = wp.vec2d(wp.float64(cells[cell][0]) + _HALF, wp.float64(cells[cell][1]) + _HALF)
        for box in range(27):
            bucket = _bucket(here, width, box // 9 - 1, (box // 3) % 3 - 1, box % 3 - 1, heads.shape[0] - 1)
            other = heads[bucket]
            while other >= 0:
                theirs = wp.vec2d(wp.float64(cells[other][0]) + _HALF, wp.float64(cells[other][1]) + _HALF)
                if _along(body, mine, theirs) + body.spacing[0] + body.spacing[1] >= body.apart:
                    away = centres[other] - here
                    if wp.dot(away, away) < width * width:
                        for point in range(begin, end):
                            place = points.place[point]
                            at, u = cell_at(body, place)
                            if _along(body, place, theirs) >= body.apart:
                                gap = wp.length(value_at(body, x, at, u) - centres[other])
                                if gap <= body.thickness + body.skin + around:
                                    _seek(body, points, slots, x, point, theirs)
                other = nexts[other]
        for point in range(begin, end):
            if slots.counts[point] > 0:
                slots.active[wp.atomic_add(slots.actives, 0, 1)] = point


@wp.kernel
def keep_nodes(
    lanes: int,
    x: wp.array(dtype=wp.float64),
    # in, out
    moved: wp.array(dtype=wp.int32),
    # out
    built: wp.array(dtype=wp.float64),
):
    """Keep the positions of a search."""
    lane = wp.tid()
    if moved[0] == 0 or moved[1] == 0:
        return
    for k in range(lane, x.shape[0], lanes):
        built[k] = x[k]


@wp.func
def _hat(body: Body, centre: wp.float64, q: wp.float64):
    """Share of a rope's point in what acts at ``q``; what lies beyond an end is reflected there."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    share = wp.max(zero, one - wp.abs(q - centre) / WINDOW)
    for end in range(2):
        mirror = wp.float64(2.0) * body.low[0] - centre
        if end == 1:
            mirror = wp.float64(2.0) * body.high[0] - centre
        share += wp.max(zero, one - wp.abs(q - mirror) / WINDOW)
    return wp.min(one, share)


@wp.kernel
def touch_itself(
    lanes: int,
    body: Body,
    points: Points,
    # model: stiffness [N/m per measure] and damping [N s/m per measure] of a point's share, Coulomb's coefficient
    stiffness: wp.float64,
    damping: wp.float64,
    friction: wp.float64,
    held: wp.array(dtype=wp.float64),
    # in
    x: wp.array(dtype=wp.float64),
    v: wp.array(dtype=wp.float64),
    clock: wp.array(dtype=wp.float64),
    # in, out
    moved: wp.array(dtype=wp.int32),
    slots: Slots,
    # out
    force: wp.array(dtype=wp.float64),
    deepest: wp.array(dtype=wp.float64),
):
    """Push the two places of every pair apart, and hold them along each other up to Coulomb's limit."""
    lane = wp.tid()
    zero = wp.float64(0.0)
    if lane == 0:
        if moved[0] == 1 and moved[1] == 1:
            moved[2] += 1
        moved[0] = 0
        moved[1] = 0
    for number in range(lane, slots.actives[0], lanes):
        point = slots.active[number]
        for k in range(slots.counts[point]):
            slot = point * NEIGHBOURS + k
            q, r = refined(body, x, points.place[point], slots.own[slot], slots.other[slot], _STEPS)
            slots.own[slot] = q
            slots.other[slot] = r
            here_cell, here_u = cell_at(body, q)
            there_cell, there_u = cell_at(body, r)
            way = value_at(body, x, here_cell, here_u) - value_at(body, x, there_cell, there_u)
            distance = wp.length(way)
            side = slots.side[slot]
            normal = side
            if distance > wp.float64(1.0e-6) * body.thickness:
                normal = way / distance
                if wp.dot(normal, side) < zero:
                    normal = -normal
                    distance = -distance
            slots.side[slot] = normal
            reach = wp.max(slots.reach[slot], wp.min(body.thickness, distance))
            slots.reach[slot] = reach
            depth = reach - distance
            share = points.measure[point]
            if body.dim == 1:
                share *= _hat(body, points.place[point][0], q[0])
            if depth <= zero or share <= zero or _along(body, q, r) < body.apart:
                slots.slip[slot] = wp.vec3d()
                continue
            if (
                wp.min(share_at(body, held, here_cell, here_u), share_at(body, held, there_cell, there_u))
                > _HALF
            ):
                continue
            slide = value_at(body, v, here_cell, here_u) - value_at(body, v, there_cell, there_u)
            approach = wp.dot(slide, normal)
            slide -= approach * normal
            pressure = wp.max(stiffness * depth - damping * approach, zero) * share
            push = pressure * normal
            if friction > zero:
                slip = slots.slip[slot] + clock[2] * slide
                slip -= wp.dot(slip, normal) * normal
                drag = share * (stiffness * slip + damping * slide)
                size = wp.length(drag)
                limit = friction * pressure
                if size > limit:
                    drag *= limit / size
                    longest = limit / (share * stiffness)
                    length = wp.length(slip)
                    if length > longest:
                        slip *= longest / length
                slots.slip[slot] = slip
                push -= drag
            add_at(body, force, here_cell, here_u, push)
            add_at(body, force, there_cell, there_u, -push)
            wp.atomic_max(deepest, 0, depth)
