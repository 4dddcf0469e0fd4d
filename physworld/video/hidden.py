"""Where tracked points are while nobody sees them: they move on with their neighbours, for pictures alone.

Measurements and errors never use these places. A hidden point is carried by the rigid motion (Kabsch) of its nearest
points that are seen, from the first frame to the present one; a point that is first seen later is carried back the same
way. In a frame without any seen point everything stays.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from physworld.arrays import Array

NEIGHBOURS = 8


def followed(points: Array, visible: Array) -> Array:
    """Tracks without gaps (T, N, 3) [m]; what is seen stays as it is.

    Args:
        points: measured points (T, N, 3) [m]; where they are not visible, their values are not used.
        visible: what is seen, (T, N), every point in some frame.
    """
    first = np.argmax(visible, axis=0)
    rest = points[first, np.arange(points.shape[1])]
    for frame in np.unique(first[first > 0]):
        late = np.flatnonzero(first == frame)
        both = np.flatnonzero(visible[0] & visible[frame])
        rest[late] = _carried(points[frame, late], points[frame, both], points[0, both])
    found = np.where(visible[..., None], points, rest)
    for frame, seen in enumerate(visible):
        hidden = np.flatnonzero(~seen)
        if not len(hidden):
            continue
        if not seen.any():
            found[frame] = found[max(frame - 1, 0)]
            continue
        found[frame, hidden] = _carried(rest[hidden], rest[seen], points[frame, seen])
    return found


def _carried(places: Array, before: Array, after: Array) -> Array:
    """Places (M, 3) after the rigid motion of their nearest neighbours ``before`` (K, 3) to ``after`` (K, 3)."""
    if not len(before):
        return places
    count = min(NEIGHBOURS, len(before))
    near = cKDTree(before).query(places, k=count)[1].reshape(len(places), count)
    old, new = before[near], after[near]
    old_centre, new_centre = old.mean(axis=1), new.mean(axis=1)
    spread = np.einsum("mki,mkj->mij", new - new_centre[:, None], old - old_centre[:, None])
    left, sizes, right = np.linalg.svd(spread)
    flip = np.ones((len(places), 3))
    flip[:, 2] = np.sign(np.linalg.det(left @ right))
    turn = (left * flip[:, None, :]) @ right
    turn[sizes[:, 1] <= 1e-9 * np.maximum(sizes[:, 0], 1e-300)] = np.eye(
        3
    )  # on a line: the turn about it is free
    moved: Array = new_centre + np.einsum("mij,mj->mi", turn, places - old_centre)
    return moved
