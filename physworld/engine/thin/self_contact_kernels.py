"""Device side of self-contact: what pushes two places of a pair apart, and what holds them along each other.

The pairs, and the legend: :mod:`physworld.engine.thin.self_contact_search`.
"""

from __future__ import annotations

import warp as wp

from physworld.engine.thin.self_contact_places import (
    WINDOW,
    Body,
    add_at,
    cell_at,
    refined,
    share_at,
    value_at,
)
from physworld.engine.thin.self_contact_search import Points, Slots, along_body, searches, turn_of

wp.set_module_options({"enable_backward": False})

_STEPS = wp.constant(1)  # of Newton's method a substep, from where the last one ended
_EARLY = wp.constant(wp.float64(0.1))  # of the skin: a pair is followed from so far beyond its touching
_HALF = wp.constant(wp.float64(0.5))


@wp.func
def _hat(body: Body, centre: wp.float64, q: wp.float64) -> wp.float64:
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
    held: wp.array[wp.float64],
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    ways: wp.array[wp.float64],
    # in, out
    moved: wp.array[wp.int32],
    slots: Slots,
    # out
    force: wp.array[wp.float64],
    deepest: wp.array[wp.float64],
) -> None:
    """Push the two places of every pair apart, and hold them along each other up to Coulomb's limit."""
    lane = wp.tid()
    zero = wp.float64(0.0)
    near = body.thickness + _EARLY * body.skin
    if searches(counter, moved):
        if lane == 0:
            moved[4] += 1
    else:
        now = turn_of(counter)
        near += wp.float64(2.0) * wp.sqrt(wp.min(ways[now], ways[now + 1]))
    for number in range(lane, slots.actives[0], lanes):
        point = slots.active[number]
        for k in range(slots.counts[point]):
            slot = point * slots.most + k
            if slots.gap[slot] > near:
                continue
            q, r = refined(body, x, slots.middles[slot], slots.own[slot], slots.other[slot], _STEPS)
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
                if distance < body.thickness and wp.dot(normal, side) < zero:
                    normal = -normal
                    distance = -distance
            slots.side[slot] = normal
            reach = wp.max(slots.reach[slot], wp.min(body.thickness, distance))
            slots.reach[slot] = reach
            depth = reach - distance
            share = points.measure[point]
            if body.dim == 1:
                share *= _hat(body, slots.middles[slot][0], q[0]) * _hat(body, slots.middles[slot][1], r[0])
            if depth <= zero or share <= zero or along_body(body, q, r) < body.apart:
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
