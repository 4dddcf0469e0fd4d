"""Device side of self-contact: where a rope or a sheet comes near to itself.

Pairs of places that are near in space and far along the body are kept in slots and followed from substep to substep
(:mod:`physworld.engine.thin.self_contact_places`). They are sought anew, on a grid in space, after the body has moved
by half the skin.

    sheet    a contact point and the nearest place of another layer: a slot a point and layer
    rope     the shortest way between the windows around two contact points i < j, with the share h(q - q_i) h(r - q_j),
             h a hat of width W: where two strands cross, the pairs around share one contact, where they lie side by
             side each point has its own

Slots: counts (S,), and K a point of places q and r, middles of a rope's windows, elastic slip [m], direction (unit)
from r to q, reach, the distance at which it touches, and the distance at the last search [m].

Legend: clock = (frame interval [s], 1/dt [1/s], dt [s]); counter = (frame, substep, substeps of this frame);
moved = (whether a node moved by half the skin, and whether so beside the middle node, of two substeps in turn; searches
so far); ways = (how far the farthest moved, squared, in the same order).
"""

from __future__ import annotations

import warp as wp

from physworld.engine.thin.self_contact_places import Body, cell_at, node_at, place_at, refined, value_at

wp.set_module_options({"enable_backward": False})

_TRIED_STEPS = wp.constant(2)  # of Newton's method, after which two places that are one are told
_FIRST_STEPS = wp.constant(6)  # and after these from the middle of a cell, or from where it was
_HALF = wp.constant(wp.float64(0.5))
_BESIDE = wp.constant(wp.float64(0.25))  # cells by which a minimum may lie outside of the cell of its seed


@wp.struct
class Points:
    """Its contact points."""

    place: wp.array[wp.vec2d]
    measure: wp.array[wp.float64]
    first: wp.array[wp.int32]  # of every cell, (C + 1,)


@wp.struct
class Slots:
    """Pairs that are near; see the module's text."""

    most: int  # K
    counts: wp.array[wp.int32]
    own: wp.array[wp.vec2d]
    other: wp.array[wp.vec2d]
    slip: wp.array[wp.vec3d]
    middles: wp.array[wp.vec2d]
    side: wp.array[wp.vec3d]
    reach: wp.array[wp.float64]
    gap: wp.array[wp.float64]
    active: wp.array[wp.int32]
    actives: wp.array[wp.int32]


@wp.func
def along_body(body: Body, q: wp.vec2d, r: wp.vec2d) -> wp.float64:
    """Distance of two places in the undeformed body [m]."""
    return wp.length(wp.cw_mul(q - r, body.spacing))


@wp.func
def _bucket(p: wp.vec3d, width: wp.float64, i: int, j: int, k: int, mask: int) -> int:
    a = int(wp.floor(p[0] / width)) + i
    b = int(wp.floor(p[1] / width)) + j
    c = int(wp.floor(p[2] / width)) + k
    return ((a * 73856093) ^ (b * 19349663) ^ (c * 83492791)) & mask


@wp.func
def turn_of(counter: wp.array[wp.int32]) -> wp.int32:
    """Where ``moved`` and ``ways`` have the numbers of this substep; the next one takes the other pair."""
    return 2 * (counter[1] % 2)


@wp.func
def searches(counter: wp.array[wp.int32], moved: wp.array[wp.int32]) -> wp.bool:
    """Whether pairs are sought in this substep."""
    now = turn_of(counter)
    return moved[now] == 1 and moved[now + 1] == 1


@wp.kernel
def watch_nodes(
    lanes: int,
    # model
    middle: int,
    most: wp.float64,
    x: wp.array[wp.float64],
    built: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in, out
    moved: wp.array[wp.int32],
    ways: wp.array[wp.float64],
) -> None:
    """How far nodes moved since the last search [m^2, squared], and whether it is farther than ``most``."""
    lane = wp.tid()
    now = turn_of(counter)
    if lane == 0:
        for k in range(2):
            moved[2 - now + k] = 0
            ways[2 - now + k] = wp.float64(0.0)
    if counter[0] == 0 and counter[1] == 0:
        moved[0] = 1
        moved[1] = 1
        if lane == 0:
            moved[4] = 0
        return
    common = node_at(x, middle) - node_at(built, middle)
    farthest = wp.float64(0.0)
    beside = wp.float64(0.0)
    for node in range(lane, x.shape[0] // 3, lanes):
        way = node_at(x, node) - node_at(built, node)
        farthest = wp.max(farthest, wp.dot(way, way))
        way -= common
        beside = wp.max(beside, wp.dot(way, way))
    wp.atomic_max(ways, now, farthest)
    wp.atomic_max(ways, now + 1, beside)
    if farthest > most:
        moved[now] = 1
    if beside > most:
        moved[now + 1] = 1


@wp.kernel
def place_cells(
    lanes: int,
    body: Body,
    width: wp.float64,
    x: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    moved: wp.array[wp.int32],
    # in, out
    heads: wp.array[wp.int32],
    # out
    centres: wp.array[wp.vec3d],
    nexts: wp.array[wp.int32],
    slots: Slots,
    deepest: wp.array[wp.float64],
) -> None:
    """Middles of the cells, and each in the list of its bucket of ``width`` [m], which are empty before.

    A run's first substep forgets all pairs.
    """
    lane = wp.tid()
    if not searches(counter, moved):
        return
    for cell in range(lane, centres.shape[0], lanes):
        centre = value_at(body, x, cell, wp.vec2d(_HALF, _HALF))
        centres[cell] = centre
        bucket = _bucket(centre, width, 0, 0, 0, heads.shape[0] - 1)
        nexts[cell] = wp.atomic_exch(heads, bucket, cell)
    if counter[0] == 0 and counter[1] == 0:
        for point in range(lane, slots.counts.shape[0], lanes):
            slots.counts[point] = 0
    if lane == 0:
        slots.actives[0] = 0
        if counter[0] == 0 and counter[1] == 0:
            deepest[0] = wp.float64(0.0)


@wp.func
def _keep_slots(body: Body, slots: Slots, x: wp.array[wp.float64], point: int) -> None:
    """Drop the pairs of a point that are no longer near, and all but the first of those that met."""
    kept = wp.int32(0)
    base = point * slots.most
    for k in range(slots.counts[point]):
        a = base + k
        q, r = refined(body, x, slots.middles[a], slots.own[a], slots.other[a], _FIRST_STEPS)
        distance = wp.length(place_at(body, x, q).x - place_at(body, x, r).x)
        near = distance <= body.thickness + body.skin and along_body(body, q, r) >= body.apart
        if near and (body.dim == 1 or _is_new(slots, base, kept, r)):
            b = base + kept
            slots.own[b] = q
            slots.other[b] = r
            slots.middles[b] = slots.middles[a]
            slots.slip[b] = slots.slip[a]
            slots.side[b] = slots.side[a]
            slots.reach[b] = slots.reach[a]
            slots.gap[b] = distance
            kept += 1
    slots.counts[point] = kept


@wp.func
def _is_new(slots: Slots, base: int, count: int, r: wp.vec2d) -> wp.bool:
    """Whether no slot has a place beside ``r``."""
    known = wp.int32(0)
    for k in range(count):
        beside = slots.other[base + k] - r
        if wp.max(wp.abs(beside[0]), wp.abs(beside[1])) < _HALF:
            known += 1
    return known == 0


@wp.func
def _has_middle(slots: Slots, base: int, count: int, middle: wp.float64) -> wp.bool:
    """Whether a slot of a rope has this partner."""
    known = wp.int32(0)
    for k in range(count):
        if slots.middles[base + k][1] == middle:
            known += 1
    return known > 0


@wp.func
def _seek(
    body: Body,
    slots: Slots,
    x: wp.array[wp.float64],
    point: int,
    own: wp.vec2d,
    other: wp.vec2d,
) -> None:
    """Give a point the pair that is found from two places, unless it has it; the nearest are kept."""
    count = slots.counts[point]
    base = point * slots.most
    middles = wp.vec2d(own[0], other[0])
    if body.dim == 1 and _has_middle(slots, base, count, other[0]):
        return
    q, r = refined(body, x, middles, own, other, _TRIED_STEPS)
    if along_body(body, q, r) < body.apart:
        return
    q, r = refined(body, x, middles, q, r, _FIRST_STEPS)
    way = place_at(body, x, q).x - place_at(body, x, r).x
    distance = wp.length(way)
    if (
        distance > body.thickness + body.skin
        or distance <= wp.float64(0.0)
        or along_body(body, q, r) < body.apart
    ):
        return
    if body.dim == 2:
        off = r - other
        if wp.max(wp.abs(off[0]), wp.abs(off[1])) > _HALF + _BESIDE or not _is_new(slots, base, count, r):
            return
    slot = base + count
    if count == slots.most:
        slot = base
        for k in range(count):
            if slots.gap[base + k] > slots.gap[slot]:
                slot = base + k
        if slots.gap[slot] <= distance:
            return
    else:
        slots.counts[point] = count + 1
    slots.own[slot] = q
    slots.other[slot] = r
    slots.middles[slot] = middles
    slots.slip[slot] = wp.vec3d()
    slots.side[slot] = way / distance
    slots.reach[slot] = wp.min(body.thickness, distance)
    slots.gap[slot] = distance


@wp.kernel
def seek_pairs(
    lanes: int,
    body: Body,
    points: Points,
    width: wp.float64,
    around: wp.float64,
    cells: wp.array[wp.vec2i],
    x: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    moved: wp.array[wp.int32],
    centres: wp.array[wp.vec3d],
    heads: wp.array[wp.int32],
    nexts: wp.array[wp.int32],
    # in, out
    slots: Slots,
) -> None:
    """Pairs of the points of every cell with what is near in space and far along the body.

    ``around``: how far from a cell's middle its material may be, or its windows reach [m].
    """
    lane = wp.tid()
    if not searches(counter, moved):
        return
    for cell in range(lane, centres.shape[0], lanes):
        begin = points.first[cell]
        end = points.first[cell + 1]
        for point in range(begin, end):
            _keep_slots(body, slots, x, point)
        here = centres[cell]
        mine = wp.vec2d(wp.float64(cells[cell][0]) + _HALF, wp.float64(cells[cell][1]) + _HALF)
        for box in range(27):
            bucket = _bucket(here, width, box // 9 - 1, (box // 3) % 3 - 1, box % 3 - 1, heads.shape[0] - 1)
            other = heads[bucket]
            while other >= 0:
                theirs = wp.vec2d(wp.float64(cells[other][0]) + _HALF, wp.float64(cells[other][1]) + _HALF)
                if along_body(body, mine, theirs) + body.spacing[0] + body.spacing[1] >= body.apart:
                    away = centres[other] - here
                    if wp.dot(away, away) < width * width:
                        for point in range(begin, end):
                            place = points.place[point]
                            at, u = cell_at(body, place)
                            here_x = value_at(body, x, at, u)
                            if along_body(body, place, theirs) >= body.apart and (
                                wp.length(here_x - centres[other]) <= body.thickness + body.skin + around
                            ):
                                if body.dim == 2:
                                    _seek(body, slots, x, point, place, theirs)
                                else:
                                    for partner in range(
                                        wp.max(point + 1, points.first[other]), points.first[other + 1]
                                    ):
                                        _seek(body, slots, x, point, place, points.place[partner])
                other = nexts[other]
        for point in range(begin, end):
            if slots.counts[point] > 0:
                slots.active[wp.atomic_add(slots.actives, 0, 1)] = point


@wp.kernel
def end_search(
    lanes: int,
    x: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    moved: wp.array[wp.int32],
    # out
    built: wp.array[wp.float64],
    heads: wp.array[wp.int32],
) -> None:
    """Keep the positions of a search, and empty the grid."""
    lane = wp.tid()
    if not searches(counter, moved):
        return
    for k in range(lane, x.shape[0], lanes):
        built[k] = x[k]
    for k in range(lane, heads.shape[0], lanes):
        heads[k] = -1
