"""The patterns of motion: which bodies move together, and where their strokes end.

A body is a grip or a pusher (control points that carry a collider). Patterns of one body against the others:

- ``single``    anywhere in the reach, turning
- ``lift``      up and down again; all grips together, or one of them
- ``push``      a pusher runs into the object and back; without a pusher a grip is pushed towards the object's middle
- ``stretch``   a grip is drawn away from the others (from the object's middle, if it is alone) and let in again
- ``twist``     a grip turns in place about the line to the others (to the object's middle)

and of several: ``together`` (as one rigid body), ``bimanual`` (all along one path, one of them along another one too),
``hold_one`` (all but one). Which of them occur, and how often, is the configuration's; a pattern that makes no sense
for the scene (twisting a single control point) is left out of the mix.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from physworld.arrays import Array
from physworld.demonstrate.limits import MotionLimits
from physworld.demonstrate.paths import Stroke
from physworld.errors import SceneUnsupported

PATTERNS = ("single", "lift", "push", "stretch", "twist", "together", "bimanual", "hold_one")
FREE = ("single", "together", "bimanual", "hold_one")
"""Motions in any direction, as the paper's: what is drawn by default. Half of a hundred episodes spent on directed ones
raised the sample's held-out error from 4.6 to 6.0 mm."""
SHORTEST_STROKE = 0.3  # of the room along a directed stroke
SIDEWAYS = 0.12  # spread of a directed stroke's end, as a share of the reach
TWIST_RAD = 1.2
LEVER_SHARE = 1e-3  # control points nearer to a twist's axis than this share of the object are on it


def patterns_for(limits: MotionLimits, first_pose: Array) -> tuple[str, ...]:
    """The patterns that make sense for these bodies at ``first_pose`` (K, 3), in the order of ``PATTERNS``."""
    grips = len(limits.grips)
    sensible = {
        "single": grips > 0,
        "lift": grips > 0,
        "push": grips > 0 or len(limits.pushers) > 0,
        "stretch": grips > 0,
        "twist": any(can_twist(limits, first_pose, g) for g in range(grips)),
        "together": grips > 1,
        "bimanual": grips > 1,
        "hold_one": grips > 2,
    }
    return tuple(name for name in PATTERNS if sensible[name])


def weighted(names: tuple[str, ...], weights: Mapping[str, float] | None) -> Array:
    """Chances of the patterns ``names``, (n,), by ``weights``; without them the ``FREE`` ones alike, or all if none is.

    Raises:
        SceneUnsupported: no weight is left for them; the message names the patterns that would do.
    """
    mix = weights or dict.fromkeys([name for name in names if name in FREE] or names, 1.0)
    given = np.array([float(mix.get(name, 0.0)) for name in names])
    if not given.sum() > 0.0:
        raise SceneUnsupported(f"the mix {dict(mix)} leaves no pattern; this scene allows {', '.join(names)}")
    shares: Array = given / given.sum()
    return shares


def check_weights(weights: Mapping[str, float]) -> None:
    """Raise ValueError for an unknown pattern, or weights that are no chances."""
    unknown = sorted(set(weights) - set(PATTERNS))
    if unknown:
        raise ValueError(f"unknown patterns {unknown}; there are {', '.join(PATTERNS)}")
    values = list(weights.values())
    if not all(np.isfinite(v) and v >= 0.0 for v in values) or not sum(values) > 0.0:
        raise ValueError(f"weights {dict(weights)} must be finite, not negative, and one of them positive")


def axis_of(limits: MotionLimits, first_pose: Array, grip: int) -> Array:
    """Unit vector from the other grips (else the object's middle) to grip number ``grip``, (3,)."""
    centre = first_pose[limits.grips[grip]].mean(axis=0)
    others = [first_pose[body].mean(axis=0) for g, body in enumerate(limits.grips) if g != grip]
    return _unit(centre - (np.mean(others, axis=0) if others else limits.object_centre_m), limits)


def lever_of(limits: MotionLimits, first_pose: Array, grip: int) -> float:
    """Largest distance [m] of the grip's control points from the axis of its twist."""
    points = first_pose[limits.grips[grip]]
    arms = points - points.mean(axis=0)
    axis = axis_of(limits, first_pose, grip)
    return float(np.linalg.norm(arms - np.outer(arms @ axis, axis), axis=1).max())


def can_twist(limits: MotionLimits, first_pose: Array, grip: int) -> bool:
    """Whether a turn about the axis moves any control point of the grip."""
    return lever_of(limits, first_pose, grip) > LEVER_SHARE * limits.size_m


def lift_stroke(limits: MotionLimits) -> Stroke:
    """Up into the reach, then back near the first height, and so on."""
    return _there_and_back(limits, limits.up, room_along(limits, limits.up), 0.0)


def push_stroke(limits: MotionLimits, first_pose: Array, body: Array, *, pusher: bool) -> Stroke:
    """Towards the object's middle, level for a grip, and back.

    A pusher may run through the middle; a grip goes at most as near as ``spread_min_m`` lets it come to the others.

    Args:
        limits: of the recording.
        first_pose: control points at the start [m], (K, 3).
        body: indices of the control points that move, (k,).
        pusher: whether they push instead of holding.
    """
    towards = limits.object_centre_m - first_pose[body].mean(axis=0)
    if not pusher:
        level = towards - (towards @ limits.up) * limits.up
        towards = level if np.linalg.norm(level) > 1e-3 * limits.size_m else towards
    way = _unit(towards, limits)
    room = room_along(limits, way)
    if pusher:
        room = min(room, float(np.linalg.norm(towards)) + 0.5 * limits.size_m)
    return _there_and_back(limits, way, room, 0.0)


def stretch_stroke(limits: MotionLimits, first_pose: Array, grip: int) -> Stroke:
    """Away from the others as far as material and its extra strain allow, and in again."""
    way = axis_of(limits, first_pose, grip)
    outwards, inwards = room_along(limits, way), room_along(limits, -way)
    centre = first_pose[limits.grips[grip]].mean(axis=0)
    for g, other in enumerate(limits.grips):
        if g != grip:
            distance = float(np.linalg.norm(first_pose[other].mean(axis=0) - centre))
            outwards = min(outwards, float(limits.spread_max_m[grip, g]) - distance)
            inwards = min(inwards, distance - float(limits.spread_min_m[grip, g]))
    return _there_and_back(limits, way, max(outwards, 0.0), 0.3 * max(inwards, 0.0), sideways=0.0)


def twist_stroke(limits: MotionLimits, axis: Array) -> Stroke:
    """Turns in place about ``axis``, to one side and then to the other."""
    most = max(TWIST_RAD, limits.turn_rad)

    def stroke(place: Array, turn: Array, number: int, generator: np.random.Generator) -> tuple[Array, Array]:
        side = -np.sign(turn @ axis) if number else generator.choice((-1.0, 1.0))
        return place, side * generator.uniform(SHORTEST_STROKE, 1.0) * most * axis

    return stroke


def room_along(limits: MotionLimits, way: Array) -> float:
    """How far [m] the reach box extends from the start along the unit vector ``way`` (3,)."""
    ends = np.where(way > 0.0, limits.reach_max_m, limits.reach_min_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(np.abs(way) > 1e-9, ends / way, np.inf)
    return max(float(shares.min()), 0.0)


def _there_and_back(
    limits: MotionLimits, way: Array, room: float, back: float, sideways: float = SIDEWAYS
) -> Stroke:
    """Even strokes end from ``SHORTEST_STROKE`` to all of ``room`` along ``way``, odd ones up to ``back`` behind."""
    spread = sideways * min(room, float(np.abs(limits.reach_max_m - limits.reach_min_m).max()))

    def stroke(place: Array, turn: Array, number: int, generator: np.random.Generator) -> tuple[Array, Array]:
        if number % 2 == 0:
            along = generator.uniform(SHORTEST_STROKE, 1.0) * room
        else:
            along = generator.uniform(-back, SHORTEST_STROKE * 0.5 * room)
        target = along * way + spread * generator.uniform(-1.0, 1.0, size=3)
        return np.clip(target, limits.reach_min_m, limits.reach_max_m), turn

    return stroke


def _unit(vector: Array, limits: MotionLimits) -> Array:
    """The direction of ``vector``; level, across gravity, where it has none."""
    length = float(np.linalg.norm(vector))
    if length > 1e-6 * limits.size_m:
        return vector / length
    level: Array = np.cross(limits.up, np.eye(3)[int(np.argmin(np.abs(limits.up)))])
    level /= np.linalg.norm(level)
    return level
