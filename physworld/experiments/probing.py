"""Motions of the grips that probe a body: few numbers each, within the scene's limits, so that a search can move them.

- ``hold``   nothing moves: gravity, creep and time act alone
- ``lift``   straight up or down, slowly or fast, a rest, and back if so chosen
- ``carry``  a Bézier path of bounded bend at the three-phase speed profile, a rest, and back if so chosen
- ``shake``  to and fro along a line at one frequency, then still: what rings on is seen
- ``turn``   the same about an axis

Every motion starts at the first pose and at rest. Numbers are coordinates in the unit cube; what a motion would do
beyond reach, speed, acceleration, turn or spread is scaled down until it keeps them. Which grips move (all as one
body, or one against the others) is part of a probe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.demonstrate.bezier import ArcLength, bent
from physworld.demonstrate.limits import MotionLimits
from physworld.demonstrate.motion import broken_limit, largest_share, rigid_points
from physworld.demonstrate.paths import GripPath, Segment
from physworld.demonstrate.speed_profile import profile_for

COORDINATES = {"hold": 0, "lift": 4, "carry": 12, "shake": 5, "turn": 5}
SLOWEST_SHARE = 0.1  # of the speed limit
FRAMES_PER_PERIOD = 6.0  # at the highest frequency: what a camera still resolves
FEWEST_PERIODS = 1.5
LEAST_TRAVEL = 0.15  # share of the reach below which a lift or a carry is not worth its time
LARGEST_BEND = 0.5  # in chords
_UP = np.array([0.0, 0.0, 1.0])
_IN_TIME = 0.8  # share of the recording within which a lift or a carry arrives, if the speed limit lets it
_MEAN_TO_PEAK = 0.7  # of the speed profile

Planned = tuple[Array, Array, Callable[[str, float], str]]
"""Displacement (T, 3) [m], rotation vector (T, 3) [rad], and the words for which grips at which scale."""


@dataclass(frozen=True)
class Probe:
    """A motion: its family, the grips that move as one body (indices into the limits' grips), coordinates (d,)."""

    family: str
    grips: tuple[int, ...]
    coordinates: Array


@dataclass(frozen=True)
class Motion:
    """A probe within the limits: points (T, K, 3) [m] and what it does, in words."""

    points: Array
    words: str


def random_probe(family: str, limits: MotionLimits, generator: np.random.Generator) -> Probe:
    """A probe of a family with random coordinates and random grips."""
    count = len(limits.grips)
    ways = [tuple(range(count)), *((g,) for g in range(count) if count > 1)]
    chosen = ways[int(generator.integers(len(ways)))]
    return Probe(family, chosen, generator.uniform(size=COORDINATES[family]))


def nudged(probe: Probe, size: float, generator: np.random.Generator) -> Probe:
    """A neighbour: every coordinate moved by ``size`` at most, reflected at the cube's faces."""
    moved = probe.coordinates + generator.uniform(-size, size, len(probe.coordinates))
    return replace(probe, coordinates=1.0 - np.abs(1.0 - np.abs(moved)))


def motion_of(probe: Probe, first_pose: Array, limits: MotionLimits, times: Array) -> Motion:
    """The motion of control points from ``first_pose`` (K, 3) at even ``times`` (T,) [s] from 0.

    Args:
        probe: the motion's numbers.
        first_pose: of the controllers, (K, 3) [m].
        limits: reach and speed of the recording's own motion.
        times: of the control track, (Tc,) [s].
    """
    held = np.concatenate([limits.grips[g] for g in probe.grips])
    arm = float(np.linalg.norm(first_pose[held] - first_pose[held].mean(axis=0), axis=1).max())
    travel, turn, words = _FAMILIES[probe.family](probe.coordinates, limits, times, arm)

    def place(scale: float) -> Array:
        points = np.repeat(first_pose[None], len(times), axis=0)
        points[:, held] = rigid_points(first_pose[held], scale * travel, scale * turn)
        return points

    scale = largest_share(lambda share: broken_limit(place(share), limits, times) is None)
    which = "the grip" if len(limits.grips) == 1 else "all grips" if len(probe.grips) > 1 else (
        f"grip {probe.grips[0] + 1} of {len(limits.grips)}"
    )  # fmt: skip
    return Motion(place(scale), words(which, scale))


def _hold(u: Array, limits: MotionLimits, times: Array, arm: float) -> Planned:
    still = np.zeros((len(times), 3))
    return still, still, lambda which, scale: f"hold {which} still for {times[-1]:.2g} s"


def _lift(u: Array, limits: MotionLimits, times: Array, arm: float) -> Planned:
    low, high = limits.reach_min_m[2], limits.reach_max_m[2]
    height = low + u[0] * (high - low)
    least = LEAST_TRAVEL * (high - low)
    if abs(height) < least:
        height = least if high >= -low else -least
    path, speed, wait = _there_and_back(height * _UP, np.zeros((2, 3)), u[1], u[2], u[3], limits, times)
    verb = "lift" if height > 0 else "lower"
    back = " and bring it back" if u[3] > 0.5 else ""

    def words(which: str, scale: float) -> str:
        return f"{verb} {which} by {_mm(scale * height)} at up to {scale * speed:.2g} m/s, wait {wait:.2g} s{back}"

    return *path.pose(times), words


def _carry(u: Array, limits: MotionLimits, times: Array, arm: float) -> Planned:
    target = limits.reach_min_m + u[:3] * (limits.reach_max_m - limits.reach_min_m)
    least = LEAST_TRAVEL * float(np.linalg.norm(limits.reach_max_m - limits.reach_min_m))
    chord = float(np.linalg.norm(target))
    if chord < least:
        target = target * (least / chord) if chord > 0 else least * np.eye(3)[0]
    bend = LARGEST_BEND * np.linalg.norm(target) * (2.0 * u[3:9].reshape(2, 3) - 1.0)
    path, speed, wait = _there_and_back(target, bend, u[9], u[10], u[11], limits, times)
    back = " and bring it back" if u[11] > 0.5 else ""

    def words(which: str, scale: float) -> str:
        to = ", ".join(f"{1e3 * scale * part:+.0f}" for part in target)
        return (
            f"carry {which} along a bent path by ({to}) mm at up to {scale * speed:.2g} m/s, "
            f"wait {wait:.2g} s{back}"
        )

    return *path.pose(times), words


def _shake(u: Array, limits: MotionLimits, times: Array, arm: float) -> Planned:
    way = _direction(u[0], u[1])
    frequency, until, wave = _wave(u[3], u[4], times)
    rate = 2.0 * np.pi * frequency
    room = np.where(
        way > 1e-9, limits.reach_max_m, np.where(way < -1e-9, -limits.reach_min_m, np.inf)
    ) / np.maximum(np.abs(way), 1e-9)
    most = min(float(room.min()), limits.speed_m_s / rate, limits.acceleration_m_s2 / rate**2)
    amplitude = most * (SLOWEST_SHARE + (1.0 - SLOWEST_SHARE) * u[2])
    travel = amplitude * wave[:, None] * way

    def words(which: str, scale: float) -> str:
        along = ", ".join(f"{part:+.2f}" for part in way)
        return (
            f"shake {which} along ({along}) by ±{_mm(scale * amplitude)} at {frequency:.2g} Hz "
            f"for {until:.2g} s, then hold it still"
        )

    return travel, np.zeros_like(travel), words


def _turn(u: Array, limits: MotionLimits, times: Array, arm: float) -> Planned:
    axis = _direction(u[0], u[1])
    frequency, until, wave = _wave(u[3], u[4], times)
    rate = 2.0 * np.pi * frequency
    arm = max(arm, 1e-3 * limits.size_m)
    most = min(limits.turn_rad, limits.speed_m_s / (rate * arm), limits.acceleration_m_s2 / (rate**2 * arm))
    angle = most * (SLOWEST_SHARE + (1.0 - SLOWEST_SHARE) * u[2])
    turn = angle * wave[:, None] * axis

    def words(which: str, scale: float) -> str:
        about = ", ".join(f"{part:+.2f}" for part in axis)
        return (
            f"turn {which} to and fro about ({about}) by ±{np.degrees(scale * angle):.0f}° at "
            f"{frequency:.2g} Hz for {until:.2g} s, then hold it still"
        )

    return np.zeros_like(turn), turn, words


_FAMILIES = {"hold": _hold, "lift": _lift, "carry": _carry, "shake": _shake, "turn": _turn}


def _there_and_back(
    target: Array,
    bend: Array,
    quick: float,
    rest: float,
    back: float,
    limits: MotionLimits,
    times: Array,
) -> tuple[GripPath, float, float]:
    """A path to ``target`` (3,) and a rest, back if ``back`` > 0.5; with its peak speed [m/s] and the rest [s]."""
    curve = bent(np.zeros(3), target, bend)
    arc = ArcLength(curve)
    in_time = arc.length / (_IN_TIME * _MEAN_TO_PEAK * float(times[-1]))
    profile = profile_for(
        arc.length,
        min(limits.speed_m_s, max(limits.speed_m_s * SLOWEST_SHARE ** (1.0 - quick), in_time)),
        acceleration_limit_m_s2=limits.acceleration_m_s2,
    )
    wait = rest * max(float(times[-1]) - profile.duration_s, 0.0)
    still = np.zeros(3)
    segments = [Segment(0.0, curve, arc, profile, still, still)]
    if back > 0.5:
        home = bent(target, np.zeros(3), bend[::-1])
        segments.append(Segment(profile.duration_s + wait, home, ArcLength(home), profile, still, still))
    return GripPath(tuple(segments)), profile.cruise_m_s, wait


def _wave(pitch: float, share: float, times: Array) -> tuple[float, float, Array]:
    """Frequency [Hz], end of the shaking [s], and a sine that swells and fades over a period each, (T,)."""
    end = float(times[-1])
    slowest = FEWEST_PERIODS / end
    fastest = max((len(times) - 1) / (end * FRAMES_PER_PERIOD), slowest)
    frequency = slowest * (fastest / slowest) ** pitch
    periods = max(round((0.3 + 0.7 * share) * end * frequency), 1)
    until = min(periods / frequency, end)
    rise = np.clip(np.minimum(times, until - times) * frequency, 0.0, 1.0)
    return frequency, until, rise**2 * (3.0 - 2.0 * rise) * np.sin(2.0 * np.pi * frequency * times)


def _direction(azimuth: float, height: float) -> Array:
    """A unit vector of the upper half sphere, evenly over it, (3,)."""
    flat = np.sqrt(1.0 - height**2)
    angle = 2.0 * np.pi * azimuth
    return np.array([flat * np.cos(angle), flat * np.sin(angle), height])


def _mm(length: float) -> str:
    return f"{1e3 * abs(length):.3g} mm"
