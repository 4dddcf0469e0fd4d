"""What a plan is to reach, as a distance [m] of predicted points to it: measured points in places, or a shape.

Shapes: … candidates and ticks, N measured points, M of the goal. A distance has the shape of the leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from physworld.arrays import Array

MOST_COMPARED = 256  # points of either side of a Chamfer distance in the search


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
        return np.linalg.norm(points[..., self.index, :] - self.places, axis=-1).mean(axis=-1)


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
        return 0.5 * (there.mean(axis=-1) + back)


def _spread(count: int) -> Array:
    return np.unique(np.linspace(0, count - 1, min(count, MOST_COMPARED)).round().astype(int))


def _thinned(points: Array) -> Array:
    return points[_spread(len(points))]
