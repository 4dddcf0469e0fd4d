"""Predictions without a model, that every twin and world model has to beat.

``static``, ``rigid_follow`` and ``constant_velocity`` know what a twin knows before it is calibrated: the
first frames of the points and the controllers of every frame. ``persistence`` holds the last place at which
a point was seen in training, which is more than a twin is given; it is reported beside the others.

Every function returns predicted positions of the tracked points [m], shape (T, N, 3), float64.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from physworld.arrays import Array
from physworld.scene import Scene

VELOCITY_FRAMES = 4
"""Frames 0..3 give the velocity that ``constant_velocity`` keeps."""

RIGID_TOLERANCE_M = 3e-3
RIGID_TOLERANCE_RELATIVE = 0.05
"""Two controllers belong to one rigid grip if their distance varies by less than the larger of 3 mm (what a
recorded hand or a marker on a bending cable shows) and 5 % of itself over the recording."""

COLLINEAR_RATIO = 1e-3
"""Controllers whose second principal extent is below this part of the first lie on a line: their turn about
it is unknown and taken as zero."""

BLENDED_GRIPS = 2


def static(scene: Scene) -> Array:
    """Every point stays where it was in frame 0."""
    return np.repeat(start_positions(scene)[None], scene.frame_count, axis=0)


def rigid_follow(scene: Scene) -> Array:
    """Every point is carried by the rigid motion of its grip, blended over the two nearest grips.

    The blend weighs each grip's motion by the inverse squared distance of the point to the grip's nearest
    controller in frame 0. Without controllers nothing moves.
    """
    start = start_positions(scene)
    groups = controller_groups(scene)
    if not groups:
        return static(scene)
    weights = _grip_weights(start, scene.controllers[0], groups)
    predicted = np.zeros((scene.frame_count, *start.shape))
    for group, weight in zip(groups, weights, strict=True):
        rest = scene.controllers[0, group]
        for t in range(scene.frame_count):
            rotation, centre, centre_now = rigid_motion(rest, scene.controllers[t, group])
            predicted[t] += weight[:, None] * ((start - centre) @ rotation.T + centre_now)
    return predicted


def constant_velocity(scene: Scene) -> Array:
    """Every point keeps the velocity that a line through its visible places in frames 0..3 has.

    A point seen in fewer than two of these frames stays at rest.
    """
    start = start_positions(scene)
    frames = min(VELOCITY_FRAMES, scene.frame_count)
    seen = scene.visible[:frames].astype(float)
    times = scene.times[:frames, None]
    count = np.maximum(seen.sum(axis=0), 1.0)
    offset = seen * (times - (seen * times).sum(axis=0) / count)
    places = np.where(scene.visible[:frames, :, None], scene.points[:frames], 0.0)
    spread = (offset**2).sum(axis=0)
    slope = (offset[..., None] * places).sum(axis=0)
    velocity = np.where(spread[:, None] > 0.0, slope / np.where(spread > 0.0, spread, 1.0)[:, None], 0.0)
    elapsed = scene.times - scene.times[0]
    tracks: Array = start[None] + elapsed[:, None, None] * velocity[None]
    return tracks


def persistence(scene: Scene) -> Array:
    """Every point follows its measured places through the training frames and then stays at the last one.

    In a frame without a measurement it stays at the last place that was seen (before any: at the start).
    """
    predicted = np.empty_like(scene.points)
    place = start_positions(scene)
    for t in range(scene.frame_count):
        if scene.train[0] <= t < scene.train[1]:
            place = np.where(scene.visible[t][:, None], scene.points[t], place)
        predicted[t] = place
    return predicted


BASELINES: dict[str, Callable[[Scene], Array]] = {
    "static": static,
    "rigid_follow": rigid_follow,
    "constant_velocity": constant_velocity,
    "persistence": persistence,
}


def start_positions(scene: Scene) -> Array:
    """Where each tracked point starts [m], (N, 3).

    Its place in frame 0; if it is hidden there, its first visible place among the training frames; if it is
    hidden in all of them, the mean of the points visible in frame 0.
    """
    train = scene.visible[scene.train[0] : scene.train[1]]
    first = scene.train[0] + np.argmax(train, axis=0)
    index = np.arange(scene.points.shape[1])
    start: Array = np.where(scene.visible[0][:, None], scene.points[0], scene.points[first, index])
    never = ~scene.visible[0] & ~train.any(axis=0)
    known = start[~never]
    if not len(known):
        raise ValueError(f"none of the {len(start)} points is visible in frame 0 or in the training frames")
    start[never] = known.mean(axis=0)
    return start


def controller_groups(scene: Scene) -> list[Array]:
    """Controller indices of each rigid grip: the declared grips, or those that keep their distances."""
    if scene.grips:
        declared = [np.asarray(grip.controllers, dtype=np.int64) for grip in scene.grips]
        held = {int(i) for group in declared for i in group}
        free = [np.array([i]) for i in range(scene.controllers.shape[1]) if i not in held]
        return [group for group in declared if len(group)] + free
    groups: list[list[int]] = []
    for i in range(scene.controllers.shape[1]):
        for group in groups:
            if all(_keeps_distance(scene.controllers[:, i], scene.controllers[:, j]) for j in group):
                group.append(i)
                break
        else:
            groups.append([i])
    return [np.asarray(group, dtype=np.int64) for group in groups]


def rigid_motion(rest: Array, now: Array) -> tuple[Array, Array, Array]:
    """Best rigid motion of points (K, 3): rotation (3, 3), centre at rest (3,), centre now (3,).

    A point x moves to ``rotation @ (x - centre) + centre_now``. Three points or more that span a plane:
    Kabsch. Points on a line: the smallest rotation that turns the line. One point: no rotation.
    """
    centre, centre_now = rest.mean(axis=0), now.mean(axis=0)
    a, b = rest - centre, now - centre_now
    _, extent, axes = np.linalg.svd(a, full_matrices=False)
    if extent[0] == 0.0:
        return np.eye(3), centre, centre_now
    if len(rest) < 3 or extent[1] < COLLINEAR_RATIO * extent[0]:
        return _smallest_rotation(axes[0], (a @ axes[0]) @ b), centre, centre_now
    u, _, vt = np.linalg.svd(b.T @ a)
    handed = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return u @ handed @ vt, centre, centre_now


def _smallest_rotation(direction: Array, towards: Array) -> Array:
    """Rotation (3, 3) by the smallest angle that turns the unit vector ``direction`` along ``towards``."""
    length = np.linalg.norm(towards)
    if length == 0.0:
        return np.eye(3)
    target = towards / length
    cosine = float(direction @ target)
    if cosine < -1.0 + 1e-12:  # half a turn: any axis across the direction does
        across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
        across /= np.linalg.norm(across)
        return 2.0 * np.outer(across, across) - np.eye(3)
    cross = np.cross(direction, target)
    skew = np.array([[0.0, -cross[2], cross[1]], [cross[2], 0.0, -cross[0]], [-cross[1], cross[0], 0.0]])
    rotation: Array = np.eye(3) + skew + skew @ skew / (1.0 + cosine)
    return rotation


def _grip_weights(start: Array, controllers: Array, groups: list[Array]) -> Array:
    """Weight of each grip for each point, (G, N), columns sum to 1, zero beyond the nearest two grips."""
    distance = np.stack(
        [np.linalg.norm(start[:, None] - controllers[None, g], axis=-1).min(axis=1) for g in groups]
    )
    smallest = max(float(distance.max()), 1e-9) * 1e-6
    weight = 1.0 / np.maximum(distance, smallest) ** 2
    if len(groups) > BLENDED_GRIPS:
        rank = np.argsort(np.argsort(distance, axis=0, kind="stable"), axis=0, kind="stable")
        weight = np.where(rank < BLENDED_GRIPS, weight, 0.0)
    shares: Array = weight / weight.sum(axis=0)
    return shares


def _keeps_distance(a: Array, b: Array) -> bool:
    """Whether two controller paths (T, 3) keep their distance, within the tolerance of one rigid grip."""
    distance = np.linalg.norm(a - b, axis=-1)
    return bool(np.ptp(distance) <= max(RIGID_TOLERANCE_M, RIGID_TOLERANCE_RELATIVE * float(distance[0])))
