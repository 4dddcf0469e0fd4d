"""Rigid paths: rotation and shift of a gripper at every frame since the first one.

What is measured of a path is noisy, and a body that is held follows its noise: a few milliradians at the grip are a
millimetre at the end of a beam, and jumps from frame to frame shake it. So the path is smoothed as stiffly as its own
noise asks for (:mod:`physworld.tracking.smoothing`), and what stays uncertain goes with it. Where a gripper is
not seen, its path goes on as it went, and the scene says how often.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.errors import TrackingFailed
from physworld.tracking.smoothing import smoothed, white_deviation

DRAWS, SEED, MODES = 256, 7, 16
LEAST_DEVIATION = 1e-7
"""[rad] and [m]: of a path that is drawn by a program."""


@dataclass(frozen=True)
class RigidPath:
    """A gripper's motion.

    Attributes:
        turns: rotation vectors since the first frame, (T, 3) [rad].
        places: of its middle [m], (T, 3).
        seen: whether it was seen, (T,) bool; elsewhere it is interpolated.
        reference: points on it at the first frame [m], (Q, 3).
        misfit_m: deviation of its points from a rigid motion.
        draws: paths that are as likely as this one, rotation vectors and places, (S, T, 6); none where its noise is
            not known.
    """

    turns: Array
    places: Array
    seen: Array
    reference: Array
    misfit_m: float
    draws: Array = field(default_factory=lambda: np.zeros((0, 0, 6)))

    def carry(self, points: Array) -> Array:
        """Points (K, 3) [m] of the first frame at every frame, (T, K, 3)."""
        return _carried(self.turns, self.places, points)

    def errors(self, points: Array, body: Array) -> Array:
        """What the path may err by, as changes of carried points (K, 3): (M, T, K, 3) [m], M = 0 where it is not known.

        They are independent and one standard deviation each, those that move the body most first; none at the first
        frame, where the points are.

        Args:
            points: of the first frame [m].
            body: places of what is held, in the first frame [m], (S, 3).
        """
        if not len(self.draws):
            return np.zeros((0, len(self.places), len(points), 3))
        low, high = body.min(axis=0), body.max(axis=0)
        corners = np.array(
            [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
        )
        both = np.concatenate([corners, points])
        usual, found = _carried(self.turns, self.places, both), []
        for draw in self.draws:
            there = _carried(draw[:, :3], draw[:, 3:], both)
            found.append(there - there[0] + both - usual)
        changes = np.array(found) / len(found) ** 0.5
        way = changes[:, :, : len(corners)].reshape(len(changes), -1)
        modes = np.linalg.eigh(way @ way.T)[1][:, ::-1][:, :MODES]
        kept: Array = np.einsum("sm,stki->mtki", modes, changes[:, :, len(corners) :])
        return kept


def rigid_path(points: Array) -> RigidPath:
    """The rigid motion of points (T, Q, 3) [m] that move together, nan where one is not seen.

    The shape is the mean of all frames, laid onto one another; then each frame's turn and place are those that fit it.

    Raises:
        TrackingFailed: in no frame are three points seen, or they are not in the first.
    """
    known: Array = np.asarray(np.isfinite(points).all(axis=2))
    seen: Array = np.asarray(known.sum(axis=1) >= 3)
    if not seen.any():
        raise TrackingFailed(f"three points of the gripper are seen in none of {len(points)} frames")
    first = int(np.argmax(seen))
    shape = np.where(known[first][:, None], points[first], np.nan)
    for _ in range(3):
        back = np.full(points.shape, np.nan)
        for frame in np.flatnonzero(seen):
            both = known[frame] & np.isfinite(shape).all(axis=1)
            if both.sum() >= 3:
                turn, shift = kabsch(points[frame, both], shape[both])
                back[frame] = points[frame] @ turn.T + shift
        with np.errstate(invalid="ignore"):
            count = np.isfinite(back).all(axis=2).sum(axis=0)
            shape = np.where(
                count[:, None] > 0, np.nansum(back, axis=0) / np.maximum(count, 1)[:, None], np.nan
            )
    usable = np.isfinite(shape).all(axis=1)
    middle = shape[usable].mean(axis=0)
    turns, places = np.zeros((len(points), 3)), np.zeros((len(points), 3))
    misfit = []
    for frame in np.flatnonzero(seen):
        both = known[frame] & usable
        seen[frame] = both.sum() >= 3
        if not seen[frame]:
            continue
        turn, shift = kabsch(shape[both], points[frame, both])
        turns[frame], places[frame] = Rotation.from_matrix(turn).as_rotvec(), turn @ middle + shift
        misfit.append(points[frame, both] - shape[both] @ turn.T - shift)
    spread = float(np.std(np.concatenate(misfit)))
    return without_noise(turns, places, seen, shape[usable], spread)


def joined(paths: list[Array]) -> Array:
    """One path (T, Q, 3) of points that several cameras see, nan where none does.

    Cameras that are calibrated a little differently put the same points a little apart: without these shifts, which
    are those of the frames that a camera shares with the one that sees most, the path does not jump where one loses
    sight. The mean of the shifts stays.

    Args:
        paths: of each camera [m], (T, Q, 3), nan where it does not see them.
    """
    stacked, shift = np.stack(paths), shifts_of(paths)
    known: Array = np.asarray(np.isfinite(stacked).all(axis=(2, 3)))
    count = known.sum(axis=0)
    total = np.where(known[..., None, None], stacked - shift[:, None, None], 0.0).sum(axis=0)
    return np.where(count[:, None, None] > 0, total / np.maximum(count, 1)[:, None, None], np.nan)


def shifts_of(paths: list[Array]) -> Array:
    """How far each camera puts the points of ``joined`` from their mean place [m], (C, 3); 0 where nothing tells."""
    known: Array = np.asarray(np.isfinite(np.stack(paths)).all(axis=(2, 3)))
    most = int(np.argmax(known.sum(axis=1)))
    shifts = np.full((len(paths), 3), np.nan)
    for number, (path, both) in enumerate(zip(paths, known & known[most], strict=True)):
        if both.any():
            shifts[number] = np.median((path - paths[most])[both].mean(axis=1), axis=0)
    told: Array = np.isfinite(shifts).all(axis=1)
    found: Array = (
        np.where(told[:, None], shifts - shifts[told].mean(axis=0), 0.0) if told.any() else 0.0 * shifts
    )
    return found


def kabsch(start: Array, end: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) and shift (3,) that lay points (Q, 3) onto others best: end = turn @ start + shift."""
    middle_from, middle_to = start.mean(axis=0), end.mean(axis=0)
    left, _, right = np.linalg.svd((end - middle_to).T @ (start - middle_from))
    left[:, 2] *= np.sign(np.linalg.det(left @ right))
    turn = left @ right
    return turn, middle_to - turn @ middle_from


def without_noise(
    turns: Array | None,
    places: Array,
    seen: Array,
    shape: Array,
    misfit_m: float,
    deviations: Array | None = None,
) -> RigidPath:
    """The path behind measured turns and places.

    Args:
        turns: rotation vectors from the pose in which ``shape`` is given, (T, 3) [rad]; None: it does not turn.
        places: of the middle [m], (T, 3).
        seen: (T,) bool.
        shape: points on it [m], (Q, 3); their middle is at ``places`` of the first frame that is seen.
        misfit_m: of the path.
        deviations: of the noise of turns and places, (T, 6), where seen; None: the same in all frames, as fifth
            differences tell.
    """
    if turns is None:
        values = places
    else:
        values = np.concatenate([_unwrapped(turns, seen), places], axis=1)
    if deviations is None:
        white = white_deviation(values, seen)
        known = None if white is None else np.tile(np.maximum(white, LEAST_DEVIATION), (len(values), 1))
    else:
        known = np.maximum(deviations, LEAST_DEVIATION)
    if known is None:
        values, draws = _between(values, seen), np.zeros((0, len(values), values.shape[1]))
    else:
        found = smoothed(values, known, seen, DRAWS, np.random.default_rng(SEED))
        values, draws = found.values, found.draws
    if turns is None:
        values, draws = (np.concatenate([np.zeros((*a.shape[:-1], 3)), a], axis=-1) for a in (values, draws))
    start = Rotation.from_rotvec(values[0, :3])
    reference = (shape - shape.mean(axis=0)) @ start.as_matrix().T + values[0, 3:]
    return RigidPath(
        _since_first(values[:, :3]),
        values[:, 3:],
        seen,
        reference,
        misfit_m,
        np.array(
            [np.concatenate([_since_first(draw[:, :3]), draw[:, 3:]], axis=1) for draw in draws]
        ).reshape(-1, len(values), 6),
    )


def _carried(turns: Array, places: Array, points: Array) -> Array:
    matrices = Rotation.from_rotvec(turns).as_matrix()
    carried: Array = np.einsum("tij,kj->tki", matrices, points - places[0]) + places[:, None]
    return carried


def _since_first(turns: Array) -> Array:
    """Rotation vectors (T, 3) from the first one's pose."""
    rotations = Rotation.from_rotvec(turns)
    found: Array = (rotations * rotations[0].inv()).as_rotvec()
    return found


def _unwrapped(turns: Array, seen: Array) -> Array:
    """The same rotations by vectors (T, 3) without a seam at pi."""
    found, last = turns.copy(), np.zeros(3)
    for frame in np.flatnonzero(seen):
        angle = float(np.linalg.norm(turns[frame]))
        if angle > 0.0:
            axis = turns[frame] / angle
            found[frame] += 2.0 * np.pi * np.round((last @ axis - angle) / (2.0 * np.pi)) * axis
        last = found[frame]
    return found


def _between(values: Array, seen: Array) -> Array:
    """Values (T, C) with what is not seen interpolated, held at the ends."""
    frames, known = np.arange(len(seen)), np.flatnonzero(seen)
    return np.stack([np.interp(frames, known, column[known]) for column in values.T], axis=1)
