"""Motions of the control points: bodies along random paths, within the scene's limits.

A grip is a group of control points that moves as one rigid body: x_k(t) = c₀ + d(t) + R(t)(x_k(0) - c₀), with
d along successive Bézier segments, each from rest to rest, and R = exp(θ(t)) turning with the segment's
normalised arc length. Every motion is a *common* path of all grips, a *relative* path of some, or both;
:mod:`physworld.demonstrate.patterns` says which and whither.

The spread between grips depends on the relative path alone, so each of its segments is drawn until it keeps
the material's length. What still passes a limit (two paths that add up, a turn) is scaled down until it keeps
it. Everything starts at the recording's first pose, at rest. The baseline ``linear`` is one grip, or all of them,
along straight lines at constant speed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.demonstrate.limits import MotionLimits
from physworld.demonstrate.paths import VMP, Allowed, GripPath, PathStyle, random_path
from physworld.demonstrate.patterns import (
    axis_of,
    can_twist,
    lever_of,
    lift_stroke,
    patterns_for,
    push_stroke,
    stretch_stroke,
    twist_stroke,
    weighted,
)

PATHS_ADDED = 0.6  # share of reach and speed for each of two paths that add up
SPEED_MARGIN = 1.25  # control points away from the centre also turn
SCALE_STEPS = 20
LINEAR = "linear"


@dataclass(frozen=True)
class Motion:
    """Control points over time.

    Attributes:
        pattern: one of the patterns, or ``linear``.
        points: control points [m], (T, K, 3).
        scale: how far the sampled motion had to be scaled down (1: not at all).
    """

    pattern: str
    points: Array
    scale: float


@dataclass(frozen=True)
class _Drawn:
    """Paths of a motion before its limits are checked.

    Attributes:
        common: of all grips, each about its own centre, or as one rigid body.
        as_one: whether the common path turns the grips as one body.
        relative: of the bodies ``movers``, each about its own centre.
        limits: what the motion must keep (a stretch may go further than the material's length).
    """

    common: GripPath = field(default_factory=GripPath)
    as_one: bool = False
    relative: GripPath = field(default_factory=GripPath)
    movers: tuple[int, ...] = ()
    limits: MotionLimits | None = None


def random_motion(
    first_pose: Array,
    limits: MotionLimits,
    times: Array,
    generator: np.random.Generator,
    pattern: str | None = None,
    *,
    weights: Mapping[str, float] | None = None,
    style: PathStyle = VMP,
) -> Motion:
    """A random motion of the control points from ``first_pose`` (K, 3) at ``times`` (T,) within the limits.

    Control points in no body stay where they are.

    Args:
        pattern: which one; None: drawn by the ``weights`` of the patterns, or the default ones.
        style: ``uniform`` gives the baseline instead of a pattern.

    Raises:
        SceneUnsupported: the weights leave no pattern that makes sense for the scene.
    """
    duration = float(times[-1])
    if style.uniform:
        pattern = LINEAR
    elif pattern is None:
        names = patterns_for(limits, first_pose)
        pattern = str(generator.choice(names, p=weighted(names, weights)))
    drawn = _draw(pattern, first_pose, limits, duration, generator, style)
    kept = limits if drawn.limits is None else drawn.limits
    common_move, common_turn = drawn.common.pose(times)
    relative_move, relative_turn = drawn.relative.pose(times)

    def place(scale: float) -> Array:
        """Control points with every displacement and turn times ``scale``."""
        points = np.repeat(first_pose[None], len(times), axis=0)
        if drawn.as_one:
            body = np.concatenate(limits.grips)
            points[:, body] = rigid_points(first_pose[body], scale * common_move, scale * common_turn)
            return points
        for b, group in enumerate(limits.bodies):
            is_grip = b < len(limits.grips)
            displacement = common_move if is_grip else np.zeros_like(common_move)
            turn = common_turn if is_grip else np.zeros_like(common_turn)
            if b in drawn.movers:
                displacement, turn = displacement + relative_move, relative_turn
            points[:, group] = rigid_points(first_pose[group], scale * displacement, scale * turn)
        return points

    scale = largest_share(lambda share: broken_limit(place(share), kept, times) is None)
    return Motion(pattern, place(scale), scale)


def broken_limit(points: Array, limits: MotionLimits, times: Array) -> str | None:
    """The first limit that control points (T, K, 3) pass, with its numbers; None when they keep all."""
    bodies = np.stack([points[:, body].mean(axis=1) for body in limits.bodies], axis=1)
    centres = bodies[:, : len(limits.grips)]
    moves = bodies - bodies[0]
    slack = 1e-9 * max(limits.size_m, 1e-3)
    if np.any(moves < limits.reach_min_m - slack) or np.any(moves > limits.reach_max_m + slack):
        return (
            f"a grip moves by {moves.min(axis=(0, 1)).round(4)} to {moves.max(axis=(0, 1)).round(4)} m, "
            f"its reach is {limits.reach_min_m.round(4)} to {limits.reach_max_m.round(4)} m"
        )
    lowest = float(points[..., 2].min())
    if lowest < limits.floor_m - slack:
        return f"a control point is at {lowest:.4f} m, the floor for them at {limits.floor_m:.4f} m"
    if not keeps_spread(centres, limits):
        return "grips come further apart than the material between them is long, or too near each other"
    speeds = np.linalg.norm(np.diff(points, axis=0), axis=-1) / np.diff(times)[:, None]
    if float(speeds.max(initial=0.0)) > SPEED_MARGIN * limits.speed_m_s:
        return f"a control point moves at {speeds.max():.3f} m/s, the limit is {limits.speed_m_s:.3f} m/s"
    return None


def rigid_points(first_pose: Array, displacement: Array, turn: Array) -> Array:
    """Points (n, 3) moved as one rigid body about their centre: (T, n, 3)."""
    centre = first_pose.mean(axis=0)
    rotations = Rotation.from_rotvec(turn).as_matrix()
    arms = np.einsum("tij,nj->tni", rotations, first_pose - centre)
    poses: Array = centre + displacement[:, None] + arms
    return poses


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


def _draw(
    pattern: str,
    first_pose: Array,
    limits: MotionLimits,
    duration: float,
    generator: np.random.Generator,
    style: PathStyle,
) -> _Drawn:
    """The paths of one pattern."""
    grips = len(limits.grips)
    several_points = max(len(body) for body in limits.bodies) > 1
    path = partial(random_path, limits, duration, generator, style=style)
    chosen = int(generator.integers(max(grips, 1)))
    others = tuple(g for g in range(grips) if g != chosen)

    def check(*movers: int) -> Allowed:
        return _spread_check(first_pose, movers, limits)

    if pattern == LINEAR:
        if grips == 0:
            return _Drawn(relative=path(), movers=tuple(range(len(limits.pushers))))
        if grips > 1 and generator.uniform() < 0.5:
            return _Drawn(common=path())
        return _Drawn(relative=path(allowed=check(chosen)), movers=(chosen,))
    if pattern == "together":
        return _Drawn(common=path(turning=True), as_one=True)
    if pattern == "bimanual":
        common = path(share=PATHS_ADDED, turning=several_points)
        relative = path(share=PATHS_ADDED, turning=several_points, allowed=check(chosen))
        return _Drawn(common=common, relative=relative, movers=(chosen,))
    if pattern == "lift":
        if grips > 1 and generator.uniform() < 0.5:
            return _Drawn(common=path(stroke=lift_stroke(limits)))
        return _Drawn(relative=path(stroke=lift_stroke(limits), allowed=check(chosen)), movers=(chosen,))
    if pattern == "push" and limits.pushers:
        number = int(generator.integers(len(limits.pushers)))
        stroke = push_stroke(limits, first_pose, limits.pushers[number], pusher=True)
        return _Drawn(relative=path(stroke=stroke), movers=(grips + number,))
    if pattern == "push":
        stroke = push_stroke(limits, first_pose, limits.grips[chosen], pusher=False)
        return _Drawn(relative=path(stroke=stroke, allowed=check(chosen)), movers=(chosen,))
    if pattern == "stretch":
        further = replace(limits, spread_max_m=(1.0 + limits.stretch) * limits.spread_max_m)
        stroke = stretch_stroke(further, first_pose, chosen)
        allowed = _spread_check(first_pose, (chosen,), further)
        return _Drawn(relative=path(stroke=stroke, allowed=allowed), movers=(chosen,), limits=further)
    if pattern == "twist":
        able = [g for g in range(grips) if can_twist(limits, first_pose, g)]
        turned = able[int(generator.integers(len(able)))]
        stroke = twist_stroke(limits, axis_of(limits, first_pose, turned))
        lever = lever_of(limits, first_pose, turned)
        return _Drawn(relative=path(stroke=stroke, lever_m=lever), movers=(turned,))
    movers = others if pattern == "hold_one" else (chosen,)
    relative = path(turning=several_points, allowed=check(*movers))
    return _Drawn(relative=relative, movers=movers)


def _spread_check(first_pose: Array, movers: tuple[int, ...], limits: MotionLimits) -> Allowed:
    """Whether displacements of the ``movers`` against the other grips keep every pair's spread."""
    first = np.stack([first_pose[grip].mean(axis=0) for grip in limits.grips])

    def allowed(displacement: Array) -> bool:
        centres = np.repeat(first[None], len(displacement), axis=0)
        centres[:, list(movers)] += displacement[:, None]
        return keeps_spread(centres, limits)

    return allowed


def keeps_spread(centres: Array, limits: MotionLimits) -> bool:
    """Whether grip centres (T, G, 3) stay within the allowed distances of each other."""
    slack = 1e-9 * max(limits.size_m, 1e-3)
    spread = np.linalg.norm(centres[:, :, None] - centres[:, None], axis=-1)
    return bool(
        np.all(spread <= limits.spread_max_m + slack) and np.all(spread >= limits.spread_min_m - slack)
    )
