"""Paths of a body in successive segments, each along a Bézier curve from rest to rest.

``GripPath.pose`` gives displacement d(t) and rotation vector θ(t). In a segment d follows the curve by arc length at
the segment's speed profile, and θ goes from one rotation vector to the next with the same normalised arc length. A
segment without a curve turns in place. Where the next segment ends is a *stroke*: a function of the place, the turn,
how many segments came before, and a generator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.demonstrate.bezier import ArcLength, CubicBezier, random_bezier, straight
from physworld.demonstrate.limits import MotionLimits
from physworld.demonstrate.speed_profile import ConstantSpeed, SpeedProfile, profile_for

RAMP_FRACTIONS = (0.15, 0.45)
SLOWEST_SHARE = 0.25  # slowest peak speed, as a share of the limit
SETTLE_S = 0.2
PAUSE_S = 0.4
PAUSE_CHANCE = 0.5
LARGEST_BEND = 0.6  # in chords, see random_bezier
SHORTEST_MOVE = 0.1  # shortest chord of a free stroke, as a share of the reach box's diagonal
SHORTEST_DIRECTED = 1e-3  # the same of a directed one
SHORTEST_TURN_RAD = 0.05
CANDIDATES = 40  # ends drawn before the body goes home instead
CHECKED_POINTS = 33

Allowed = Callable[[Array], bool]  # displacements (n, 3) of a body: do they keep their limits?
Stroke = Callable[[Array, Array, int, np.random.Generator], tuple[Array, Array]]


@dataclass(frozen=True)
class Segment:
    """One movement from rest to rest.

    Attributes:
        start_s: when it begins.
        curve: the displacement's path [m]; None turns in place.
        arc: arc length of ``curve``; None turns in place.
        profile: speed along it.
        turn_from, turn_to: rotation vectors [rad], (3,).
        place: displacement of a turn in place [m], (3,).
    """

    start_s: float
    curve: CubicBezier | None
    arc: ArcLength | None
    profile: SpeedProfile | ConstantSpeed
    turn_from: Array
    turn_to: Array
    place: Array | None = None

    def displacement(self, share: Array) -> Array:
        """Where ``share`` (n,) of the way leads [m], (n, 3)."""
        if self.curve is None or self.arc is None:
            return np.repeat(np.zeros((1, 3)) if self.place is None else self.place[None], len(share), axis=0)
        return self.curve.position(self.arc.parameter(share * self.arc.length))


@dataclass(frozen=True)
class GripPath:
    """Displacement and rotation over time: segments, with rests between them."""

    segments: tuple[Segment, ...] = ()

    def pose(self, times: Array) -> tuple[Array, Array]:
        """Displacement [m] (T, 3) and rotation vector [rad] (T, 3)."""
        displacement, turn = np.zeros((len(times), 3)), np.zeros((len(times), 3))
        starts = [segment.start_s for segment in self.segments]
        owner = np.searchsorted(starts, times, side="right") - 1  # the segment that began last
        for number, segment in enumerate(self.segments):
            mine = owner == number
            if not mine.any():
                continue
            share = segment.profile.progress(times[mine] - segment.start_s)
            displacement[mine] = segment.displacement(share)
            turn[mine] = segment.turn_from + share[:, None] * (segment.turn_to - segment.turn_from)
        return displacement, turn


@dataclass(frozen=True)
class PathStyle:
    """How segments are made.

    Attributes:
        uniform: straight lines at constant speed, without rests (the paper's baseline); else VMP-Gen.
        curvature_limit: largest κ · chord of a curve.
        arc_tolerance: relative accuracy of the arc-length parameterisation.
    """

    uniform: bool = False
    curvature_limit: float = 6.0
    arc_tolerance: float = 1e-9


VMP = PathStyle()


def random_path(
    limits: MotionLimits,
    duration_s: float,
    generator: np.random.Generator,
    *,
    share: float = 1.0,
    turning: bool = False,
    allowed: Allowed | None = None,
    stroke: Stroke | None = None,
    lever_m: float = 0.0,
    style: PathStyle = VMP,
) -> GripPath:
    """Successive random segments until ``duration_s`` is full, in ``share`` of the reach and the speed.

    Args:
        turning: whether free strokes turn the body.
        allowed: which displacements are; None: all in the reach.
        stroke: where segments end; None: anywhere in the reach.
        lever_m: largest distance of a point from the axis of a turn in place.
    """
    box = (share * limits.reach_min_m, share * limits.reach_max_m)
    draw = free_stroke(box, limits.turn_rad if turning else 0.0) if stroke is None else stroke
    shortest = SHORTEST_MOVE if stroke is None else SHORTEST_DIRECTED
    place, turn = np.zeros(3), np.zeros(3)
    clock = 0.0 if style.uniform else generator.uniform(0.0, SETTLE_S)
    segments: list[Segment] = []
    while clock < duration_s:
        found = _next_curve(place, turn, len(segments), box, shortest, generator, allowed, draw, style)
        if found is None:
            break
        curve, turn_to = found
        arc = None if curve is None else ArcLength(curve, style.arc_tolerance)
        length = float(np.linalg.norm(turn_to - turn)) * lever_m if arc is None else arc.length
        peak = share * limits.speed_m_s * SLOWEST_SHARE ** generator.uniform(0.0, 1.0)
        profile: SpeedProfile | ConstantSpeed
        if style.uniform:
            profile = ConstantSpeed(length / peak)
        else:
            rise, fall = generator.uniform(*RAMP_FRACTIONS, size=2)
            profile = profile_for(
                length,
                peak,
                accelerate_fraction=rise,
                decelerate_fraction=fall,
                acceleration_limit_m_s2=limits.acceleration_m_s2,
            )
        segments.append(Segment(clock, curve, arc, profile, turn, turn_to, None if curve else place))
        place, turn = place if curve is None else curve.points[3], turn_to
        clock += profile.duration_s
        if not style.uniform and generator.uniform() < PAUSE_CHANCE:
            clock += generator.uniform(0.0, PAUSE_S)
    return GripPath(tuple(segments))


def free_stroke(box: tuple[Array, Array], turn_rad: float) -> Stroke:
    """Ends anywhere in the box, with a random rotation of at most ``turn_rad``."""

    def stroke(place: Array, turn: Array, number: int, generator: np.random.Generator) -> tuple[Array, Array]:
        target = generator.uniform(*box)
        return target, random_turn(turn_rad, generator) if turn_rad > 0.0 else turn

    return stroke


def random_turn(limit_rad: float, generator: np.random.Generator) -> Array:
    """A rotation vector with uniform direction and an angle up to the limit."""
    axis = generator.standard_normal(3)
    return axis / np.linalg.norm(axis) * limit_rad * generator.uniform()


def _next_curve(
    place: Array,
    turn: Array,
    number: int,
    box: tuple[Array, Array],
    shortest_share: float,
    generator: np.random.Generator,
    allowed: Allowed | None,
    draw: Stroke,
    style: PathStyle,
) -> tuple[CubicBezier | None, Array] | None:
    """A curve that is allowed and the turn at its end; else straight home; None when it is there already.

    The curve is None where the stroke is a turn in place.
    """
    shortest = shortest_share * float(np.linalg.norm(box[1] - box[0]))
    u = np.linspace(0.0, 1.0, CHECKED_POINTS)
    for _ in range(CANDIDATES):
        target, turn_to = draw(place, turn, number, generator)
        if np.array_equal(target, place):
            if np.linalg.norm(turn_to - turn) < SHORTEST_TURN_RAD:
                continue
            return None, turn_to
        if np.linalg.norm(target - place) < shortest:
            continue
        if style.uniform:
            curve = straight(place, target)
        else:
            bend = generator.uniform(0.0, LARGEST_BEND)
            curve = random_bezier(
                place, target, generator, bend=bend, curvature_limit=style.curvature_limit, box=box
            )
        if allowed is None or allowed(curve.position(u)):
            return curve, turn_to
    return (straight(place, np.zeros(3)), turn) if np.linalg.norm(place) > 0.0 else None
