"""A few points that stand for many: farthest-point sampling of an episode's first frame."""

from __future__ import annotations

import numpy as np

from physworld_client.types import Array


def spread_points(points: Array, count: int | None) -> Array:
    """Indices (n,) of at most ``count`` of the points (P, 3) [m], ascending: each the farthest from those before it.

    The first one is the nearest to the middle, so equal points give equal indices. None: all of them.
    """
    if count is None or count >= len(points):
        return np.arange(len(points))
    places = np.asarray(points, dtype=np.float64)
    chosen = np.empty(count, dtype=np.int64)
    chosen[0] = int(np.argmin(np.sum((places - places.mean(axis=0)) ** 2, axis=1)))
    squared = np.sum((places - places[chosen[0]]) ** 2, axis=1)
    for i in range(1, count):
        chosen[i] = int(np.argmax(squared))
        squared = np.minimum(squared, np.sum((places - places[chosen[i]]) ** 2, axis=1))
    return np.sort(chosen)
