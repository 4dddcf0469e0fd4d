"""Motions of the grips: rigid bodies along Bézier paths at three-phase speed, within the scene's limits.

A grip is a group of control points that moves as one rigid body: x_k(t) = c₀ + d(t) + R(t)(x_k(0) - c₀), with
d along successive Bézier segments, each from rest to rest, and R = exp(θ(t)) turning with the segment's
normalised arc length. Every motion is a *common* path of all grips, a *relative* path of some, or both:

- ``single``    one grip moves (relative), the others stay
- ``together``  all grips move and turn as one rigid body (common)
- ``bimanual``  all grips move (common), one of them also against the others (relative)
- ``hold_one``  one grip stays, the others move (relative)

The spread between grips depends on the relative path alone, so each of its segments is drawn until it keeps
the material's length. What still passes a limit (two paths that add up, a turn) is scaled down until it keeps
it. Everything starts at the recording's first pose, at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from physworld.demonstrate.bezier import ArcLength, CubicBezier, random_bezier, straight
from physworld.demonstrate.limits import MotionLimits
from physworld.demonstrate.speed_profile import SpeedProfile, profile_for

RAMP_FRACTIONS = (0.15, 0.45)
SLOWEST_SHARE = 0.25  # slowest peak speed, as a share of the limit
SETTLE_S = 0.2
PAUSE_S = 0.4
PAUSE_CHANCE = 0.5
LARGEST_BEND = 0.6  # in chords, see random_bezier
SHORTEST_MOVE = 0.1  # shortest chord, as a share of the reach box's diagonal
PATHS_ADDED = 0.6  # share of reach and speed for each of two paths that add up
SPEED_MARGIN = 1.25  # control points away from the centre also turn
CANDIDATES = 40  # segments drawn before the grip goes home instead
CHECKED_POINTS = 33
SCALE_STEPS = 20

Allowed = Callable[[np.ndarray], bool]  # displacements (n, 3) of the moving grips: do they keep their limits?


@dataclass(frozen=True)
class Segment:
    """One movement from rest to rest.

    Attributes:
        start_s: when it begins.
        curve: the displacement's path [m].
        arc: arc length of ``curve``.
        profile: speed along it.
        turn_from, turn_to: rotation vectors [rad], (3,).
    """

    start_s: float
    curve: CubicBezier
    arc: ArcLength
    profile: SpeedProfile
    turn_from: np.ndarray
    turn_to: np.ndarray


@dataclass(frozen=True)
class GripPath:
    """Displacement and rotation over time: segments, with rests between them."""

    segments: tuple[Segment, ...] = ()

    def pose(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacement [m] (T, 3) and rotation vector [rad] (T, 3)."""
        displacement, turn = np.zeros((len(times), 3)), np.zeros((len(times), 3))
        for segment in self.segments:
            begun = times >= segment.start_s
            if not begun.any():
                break
            since = times[begun] - segment.start_s
            share = segment.profile.progress(since)
            u = segment.arc.parameter(share * segment.arc.length)
            displacement[begun] = segment.curve.position(u)
            turn[begun] = segment.turn_from + share[:, None] * (segment.turn_to - segment.turn_from)
        return displacement, turn


@dataclass(frozen=True)
class Motion:
    """Control points over time.

    Attributes:
        pattern: one of the patterns above.
        points: control points [m], (T, K, 3).
        scale: how far the sampled motion had to be scaled down (1: not at all).
    """

    pattern: str
    points: np.ndarray
    scale: float


def patterns_for(grips: int) -> tuple[str, ...]:
    """The patterns that differ from each other with this many grips."""
    if grips == 1:
        return ("single",)
    shared = ("single", "together", "bimanual")
    return shared if grips == 2 else (*shared, "hold_one")


def random_motion(
    first_pose: np.ndarray,
    limits: MotionLimits,
    times: np.ndarray,
    generator: np.random.Generator,
    pattern: str | None = None,
) -> Motion:
    """A random motion of the control points from ``first_pose`` (K, 3) at ``times`` (T,) within the limits.

    Control points in no grip stay where they are.
    """
    groups, grips = limits.grips, len(limits.grips)
    pattern = str(generator.choice(patterns_for(grips))) if pattern is None else pattern
    duration = float(times[-1])
    share = PATHS_ADDED if pattern == "bimanual" else 1.0
    turning = pattern == "together" or max(len(group) for group in groups) > 1
    common, relative = GripPath(), GripPath()
    movers = _movers(pattern, grips, generator)
    if pattern in ("together", "bimanual"):
        common = random_path(limits, duration, generator, share=share, turning=turning)
    if len(movers):
        allowed = _spread_check(first_pose, movers, limits)
        relative = random_path(limits, duration, generator, share=share, turning=turning, allowed=allowed)
    common_move, common_turn = common.pose(times)
    relative_move, relative_turn = relative.pose(times)

    def place(scale: float) -> np.ndarray:
        """Control points with every displacement and turn times ``scale``."""
        points = np.repeat(first_pose[None], len(times), axis=0)
        if pattern == "together":
            body = np.concatenate(groups)
            points[:, body] = rigid_points(first_pose[body], scale * common_move, scale * common_turn)
            return points
        for g, group in enumerate(groups):
            moves = g in movers
            displacement = common_move + relative_move if moves else common_move
            turn = relative_turn if moves else common_turn
            points[:, group] = rigid_points(first_pose[group], scale * displacement, scale * turn)
        return points

    scale = largest_share(lambda share: broken_limit(place(share), limits, times) is None)
    return Motion(pattern, place(scale), scale)


def random_path(
    limits: MotionLimits,
    duration_s: float,
    generator: np.random.Generator,
    *,
    share: float = 1.0,
    turning: bool = False,
    allowed: Allowed | None = None,
) -> GripPath:
    """Successive random segments until ``duration_s`` is full, in ``share`` of the reach and the speed."""
    box = (share * limits.reach_min_m, share * limits.reach_max_m)
    place, turn = np.zeros(3), np.zeros(3)
    clock = generator.uniform(0.0, SETTLE_S)
    segments = []
    while clock < duration_s:
        curve = _next_curve(place, box, generator, allowed)
        if curve is None:
            break
        arc = ArcLength(curve)
        rise, fall = generator.uniform(*RAMP_FRACTIONS, size=2)
        profile = profile_for(
            arc.length,
            share * limits.speed_m_s * SLOWEST_SHARE ** generator.uniform(0.0, 1.0),
            accelerate_fraction=rise,
            decelerate_fraction=fall,
            acceleration_limit_m_s2=limits.acceleration_m_s2,
        )
        turn_to = _random_turn(limits.turn_rad, generator) if turning else turn
        segments.append(Segment(clock, curve, arc, profile, turn, turn_to))
        place, turn = curve.points[3], turn_to
        clock += profile.duration_s
        if generator.uniform() < PAUSE_CHANCE:
            clock += generator.uniform(0.0, PAUSE_S)
    return GripPath(tuple(segments))


def broken_limit(points: np.ndarray, limits: MotionLimits, times: np.ndarray) -> str | None:
    """The first limit that control points (T, K, 3) pass, with its numbers; None when they keep all."""
    centres = np.stack([points[:, grip].mean(axis=1) for grip in limits.grips], axis=1)
    moves = centres - centres[0]
    slack = 1e-9 * max(limits.size_m, 1e-3)
    if np.any(moves < limits.reach_min_m - slack) or np.any(moves > limits.reach_max_m + slack):
        return (
            f"a grip moves by {moves.min(axis=(0, 1)).round(4)} to {moves.max(axis=(0, 1)).round(4)} m, "
            f"its reach is {limits.reach_min_m.round(4)} to {limits.reach_max_m.round(4)} m"
        )
    lowest = float(points[..., 2].min())
    if lowest < limits.floor_m - slack:
        return f"a control point is at {lowest:.4f} m, the floor for them at {limits.floor_m:.4f} m"
    if not _keeps_spread(centres, limits):
        return "grips come further apart than the material between them is long, or too near each other"
    speeds = np.linalg.norm(np.diff(points, axis=0), axis=-1) / np.diff(times)[:, None]
    if float(speeds.max(initial=0.0)) > SPEED_MARGIN * limits.speed_m_s:
        return f"a control point moves at {speeds.max():.3f} m/s, the limit is {limits.speed_m_s:.3f} m/s"
    return None


def rigid_points(first_pose: np.ndarray, displacement: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Points (n, 3) moved as one rigid body about their centre: (T, n, 3)."""
    centre = first_pose.mean(axis=0)
    rotations = Rotation.from_rotvec(turn).as_matrix()
    arms = np.einsum("tij,nj->tni", rotations, first_pose - centre)
    return centre + displacement[:, None] + arms


def _movers(pattern: str, grips: int, generator: np.random.Generator) -> np.ndarray:
    """Indices of the grips with a relative path."""
    chosen = int(generator.integers(grips))
    if pattern == "together":
        return np.empty(0, dtype=np.int64)
    return np.delete(np.arange(grips), chosen) if pattern == "hold_one" else np.array([chosen])


def _next_curve(
    place: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
    generator: np.random.Generator,
    allowed: Allowed | None,
) -> CubicBezier | None:
    """A random curve from ``place`` that is allowed; else straight home; None when it is there already."""
    shortest = SHORTEST_MOVE * float(np.linalg.norm(box[1] - box[0]))
    u = np.linspace(0.0, 1.0, CHECKED_POINTS)
    for _ in range(CANDIDATES):
        target = generator.uniform(*box)
        bend = generator.uniform(0.0, LARGEST_BEND)
        if np.linalg.norm(target - place) < shortest:
            continue
        curve = random_bezier(place, target, generator, bend=bend, box=box)
        if allowed is None or allowed(curve.position(u)):
            return curve
    return straight(place, np.zeros(3)) if np.linalg.norm(place) > 0.0 else None


def _spread_check(first_pose: np.ndarray, movers: np.ndarray, limits: MotionLimits) -> Allowed:
    """Whether displacements of the ``movers`` against the other grips keep every pair's spread."""
    first = np.stack([first_pose[grip].mean(axis=0) for grip in limits.grips])

    def allowed(displacement: np.ndarray) -> bool:
        centres = np.repeat(first[None], len(displacement), axis=0)
        centres[:, movers] += displacement[:, None]
        return _keeps_spread(centres, limits)

    return allowed


def _keeps_spread(centres: np.ndarray, limits: MotionLimits) -> bool:
    """Whether grip centres (T, G, 3) stay within the allowed distances of each other."""
    slack = 1e-9 * max(limits.size_m, 1e-3)
    spread = np.linalg.norm(centres[:, :, None] - centres[:, None], axis=-1)
    return bool(
        np.all(spread <= limits.spread_max_m + slack) and np.all(spread >= limits.spread_min_m - slack)
    )


def _random_turn(limit_rad: float, generator: np.random.Generator) -> np.ndarray:
    """A rotation vector with uniform direction and an angle up to the limit."""
    axis = generator.standard_normal(3)
    return axis / np.linalg.norm(axis) * limit_rad * generator.uniform()


def largest_share(kept: Callable[[float], bool]) -> float:
    """The largest share in [0, 1] that bisection finds to be kept; 0 is taken to be."""
    if kept(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(SCALE_STEPS):
        middle = 0.5 * (low + high)
        if kept(middle):
            low = middle
        else:
            high = middle
    return low
