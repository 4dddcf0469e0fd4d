"""What a plan is to reach, and what the grips may do on the way.

*Goals* are distances [m] of predicted points to measured points in places, or to a shape. Shapes: … candidates and
ticks, N measured points, M of the goal. A distance has the shape of the leading axes.

*Limits* are speed, acceleration, workspace and distances of the grips, and the nearest motion that keeps to them.
Motions are translations: velocities of G grips over T ticks, (…, T, G, 3) [m/s]; a grip's displacement at tick t is the
sum of its velocities up to t, times dt. Turning a grip is left to whoever drives it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from physworld.arrays import Array

MOST_COMPARED = 256  # points of either side of a Chamfer distance in the search
SPREAD_PASSES = 2
ROUNDING = 1e-9


class Goal(Protocol):
    """A distance to be made small."""

    def distance(self, points: Array) -> Array:
        """Mean distance [m] of points (…, N, 3) to the goal, (…)."""


@dataclass(frozen=True)
class GoalPoints:
    """Points ``index`` (M,) at ``places`` (M, 3) [m]: the mean Euclidean distance."""

    index: Array
    places: Array

    def distance(self, points: Array) -> Array:
        """See :class:`Goal`."""
        mean: Array = np.linalg.norm(points[..., self.index, :] - self.places, axis=-1).mean(axis=-1)
        return mean


@dataclass(frozen=True)
class GoalShape:
    """The body in the shape of a cloud (M, 3) [m]: two-way Chamfer distance, half the sum of both means.

    Both sides are thinned to ``MOST_COMPARED`` points that are spread by their order.
    """

    shape: Array

    def distance(self, points: Array) -> Array:
        """See :class:`Goal`."""
        goal = _thinned(self.shape)
        tree = cKDTree(goal)
        points = points[..., _spread(points.shape[-2]), :]
        there, _ = tree.query(points)
        flat = points.reshape(-1, *points.shape[-2:])
        back = np.array([cKDTree(cloud).query(goal)[0].mean() for cloud in flat]).reshape(points.shape[:-2])
        chamfer: Array = 0.5 * (there.mean(axis=-1) + back)
        return chamfer


def _spread(count: int) -> Array:
    return np.unique(np.linspace(0, count - 1, min(count, MOST_COMPARED)).round().astype(int))


def _thinned(points: Array) -> Array:
    return points[_spread(len(points))]


@dataclass(frozen=True)
class GripLimits:
    """Limits of every grip.

    Attributes:
        speed_m_s, acceleration_m_s2: largest.
        box_min_m, box_max_m: of a grip's displacement from where the plan starts, (G, 3).
        spread_max_m: largest distance between grip centres, (G, G), infinite where none.
        centres_m: of the grips where the plan starts, (G, 3).
        start_m_s: velocities that the grips have there, (G, 3); None: they are at rest.
    """

    speed_m_s: float
    acceleration_m_s2: float
    box_min_m: Array
    box_max_m: Array
    spread_max_m: Array
    centres_m: Array
    start_m_s: Array | None = None

    @property
    def started_m_s(self) -> Array:
        """Velocities of the grips where the plan starts, (G, 3)."""
        return np.zeros_like(self.centres_m) if self.start_m_s is None else self.start_m_s

    def kept(self, velocities: Array, dt_s: float) -> Array:
        """Velocities (…, T, G, 3) cut to the limits, tick by tick: acceleration, speed, workspace, spread.

        The first tick's acceleration is from the velocities that the grips have where the plan starts.
        Where a grip meets the end of its workspace it stops there within the tick: the workspace comes before the
        acceleration. Where one that pulls another along would make it too fast, both go a part of the way: from places
        that keep workspace and spread to places that do, every part does.
        """
        out = np.empty_like(velocities)
        place = np.zeros(velocities.shape[:-3] + velocities.shape[-2:])
        before = np.broadcast_to(self.started_m_s, place.shape)
        for t in range(velocities.shape[-3]):
            change = _shortened(velocities[..., t, :, :] - before, self.acceleration_m_s2 * dt_s)
            wanted = place + dt_s * _shortened(before + change, self.speed_m_s)
            wanted = self._apart(np.clip(wanted, self.box_min_m, self.box_max_m))
            wanted = np.clip(wanted, self.box_min_m, self.box_max_m)
            wanted = self._slowed(place, wanted, self.speed_m_s * dt_s)
            out[..., t, :, :] = before = (wanted - place) / dt_s
            place = wanted
        return out

    def _slowed(self, place: Array, wanted: Array, longest_m: float) -> Array:
        """Places (…, G, 3) on the straight way to the wanted ones where no grip moves by more than ``longest_m``."""
        move = np.linalg.norm(wanted - place, axis=-1).max(axis=-1)[..., None, None]
        fast = move > longest_m * (1.0 + ROUNDING)
        return np.where(fast, place + (wanted - place) * (longest_m / np.maximum(move, 1e-300)), wanted)

    def _apart(self, place: Array) -> Array:
        """Displacements (…, G, 3) with no two grips farther from each other than the material between them is long."""
        count = place.shape[-2]
        for _ in range(SPREAD_PASSES if count > 1 else 0):
            for i in range(count):
                for j in range(i + 1, count):
                    gap = self.centres_m[j] + place[..., j, :] - self.centres_m[i] - place[..., i, :]
                    length = np.linalg.norm(gap, axis=-1, keepdims=True)
                    excess = np.maximum(length - self.spread_max_m[i, j], 0.0) / np.maximum(length, 1e-12)
                    place = place.copy()
                    place[..., i, :] += 0.5 * excess * gap
                    place[..., j, :] -= 0.5 * excess * gap
        return place


def _shortened(vectors: Array, longest: float) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    shortened: Array = vectors * np.minimum(1.0, longest / np.maximum(length, 1e-300))
    return shortened
