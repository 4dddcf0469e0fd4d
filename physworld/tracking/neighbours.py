"""How neighbours of a point move: similarity in the picture, rigid motion in space.

Neighbours are those of the first frame. In the picture they say how a patch is turned and stretched by now, and where a
lost point must be; in space, whether a point goes with the material around it. Weights fall with distance, and are
halved again and again for those that disagree (iteratively reweighted least squares).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from physworld.arrays import Array

ROUNDS = 3
RIDGE = 0.3
"""Weight of the similarity against what neighbours say of shear: those of a rope lie on one line."""
LEAST = 3


def nearest(places: Array, count: int) -> Array:
    """Indices (N, K) of each place's neighbours, nearest first, itself left out; K is at most N - 1.

    Args:
        places: in the first frame [m], (N, 3).
        count: neighbours wanted.
    """
    count = min(count, len(places) - 1)
    _, index = cKDTree(places).query(places, k=count + 1)
    return np.asarray(index).reshape(len(places), count + 1)[:, 1:]


def picture_motion(
    start: Array, now: Array, known: Array, neighbours: Array, scale_px: float = 1.0
) -> tuple[Array, Array, Array]:
    """Where neighbours put every point, the affine map of its surroundings since the first frame, and how many say so.

    Args:
        start: pixels in the first frame, (N, 2).
        now: pixels now, (N, 2).
        known: whose place now is known, (N,) bool.
        neighbours: (N, K).
        scale_px: disagreement from which weights fall.

    Returns:
        Places (N, 2), maps (N, 2, 2), counts (N,).
    """
    offsets, moved = start[neighbours] - start[:, None], now[neighbours]
    base = known[neighbours] / (np.linalg.norm(offsets, axis=2) + 3.0)
    weights, places, maps = base, start.copy(), np.tile(np.eye(2), (len(start), 1, 1))
    for _ in range(ROUNDS):
        places, maps = _affine(offsets, moved, weights)
        miss = np.linalg.norm(moved - places[:, None] - np.einsum("nij,nkj->nki", maps, offsets), axis=2)
        weights = base / (1.0 + (miss / scale_px) ** 2)
    return places, maps, known[neighbours].sum(axis=1)


def _affine(offsets: Array, moved: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted fit moved = place + map @ offset, shear held by a ridge towards the best similarity."""
    total = np.maximum(weights.sum(axis=1), 1e-12)
    mean_from = np.einsum("nk,nki->ni", weights, offsets) / total[:, None]
    mean_to = np.einsum("nk,nki->ni", weights, moved) / total[:, None]
    x, y = offsets - mean_from[:, None], moved - mean_to[:, None]
    spread = np.einsum("nk,nki,nkj->nij", weights, x, x) / total[:, None, None]
    cross = np.einsum("nk,nki,nkj->nij", weights, y, x) / total[:, None, None]
    size = np.trace(spread, axis1=1, axis2=2) + 1e-9
    cosine = (cross[:, 0, 0] + cross[:, 1, 1]) / size
    sine = (cross[:, 1, 0] - cross[:, 0, 1]) / size
    unknown = np.hypot(cosine, sine) < 1e-6
    cosine = np.where(unknown, 1.0, cosine)
    similar = np.stack([np.stack([cosine, -sine], 1), np.stack([sine, cosine], 1)], 1)
    ridge = RIDGE * size[:, None, None] * np.eye(2)
    maps = (cross + similar @ ridge) @ np.linalg.inv(spread + ridge)
    places = mean_to - np.einsum("nij,nj->ni", maps, mean_from)
    return places, maps


def rigid_misfit(start: Array, now: Array, known: Array, neighbours: Array) -> tuple[Array, Array]:
    """How far every point is from where the rigid motion of its neighbours puts it [m], and that place.

    Args:
        start: places in the first frame [m], (N, 3).
        now: places now [m], (N, 3).
        known: whose place now is known, (N,) bool.
        neighbours: (N, K).

    Returns:
        Distances (N,), inf where fewer than 3 neighbours are known, and places (N, 3).
    """
    mine = known[neighbours]
    places = _carried(start, start[neighbours], now[neighbours], mine)
    distance = np.linalg.norm(now - places, axis=1)
    return np.where(mine.sum(axis=1) >= LEAST, distance, np.inf), places


def carried(at: Array, start: Array, now: Array, count: int) -> Array | None:
    """Where places of the first frame are now, as the rigid motion of the nearest points carries them, (n, 3) [m].

    Args:
        at: the places [m], (n, 3).
        start, now: of the points that are seen now [m], (M, 3); too few of them: None.
        count: of points that carry each.
    """
    if len(start) < max(count // 2, LEAST):
        return None
    count = min(count, len(start))
    _, nearest_ones = cKDTree(start).query(at, k=count)
    return _carried(at, start[nearest_ones], now[nearest_ones], np.ones(nearest_ones.shape, dtype=bool))


def _carried(at: Array, start: Array, moved: Array, known: Array) -> Array:
    """Places (N, 3) that the rigid motion of each one's neighbours gives.

    Args:
        at: in the first frame [m], (N, 3).
        start, moved: neighbours in the first frame and now [m], (N, K, 3).
        known: which of them count, (N, K) bool.
    """
    offsets = start - at[:, None]
    base = known / (np.linalg.norm(offsets, axis=2) + 1e-3)
    scale = np.median(np.linalg.norm(offsets, axis=2)) * 0.05 + 1e-4
    weights, places = base, at.copy()
    for _ in range(ROUNDS):
        total = np.maximum(weights.sum(axis=1), 1e-12)[:, None]
        mean_from = np.einsum("nk,nki->ni", weights, offsets) / total
        mean_to = np.einsum("nk,nki->ni", weights, moved) / total
        cross = np.einsum("nk,nki,nkj->nij", weights, moved - mean_to[:, None], offsets - mean_from[:, None])
        left, _, right = np.linalg.svd(cross)
        sign = np.ones((len(at), 3))
        sign[:, 2] = np.sign(np.linalg.det(left @ right))
        turn = (left * sign[:, None]) @ right
        places = mean_to - np.einsum("nij,nj->ni", turn, mean_from)
        miss = np.linalg.norm(moved - places[:, None] - np.einsum("nij,nkj->nki", turn, offsets), axis=2)
        weights = base / (1.0 + (miss / scale) ** 2)
    return places
