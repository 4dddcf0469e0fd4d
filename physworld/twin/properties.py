"""Fields of physical properties over the particles: log factors of stiffness, density and the ground's friction.

A calibrated twin may carry a field of its own (the local stage's), and a run may be given another one on top of it (a
demonstration's): the logarithms add up.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from physworld.arrays import Array

_NEIGHBOURS = 8


def together(*fields: Array | None) -> Array | None:
    """The sum of fields (P, 2) or (P, 3); a missing column is zero. None if there is none.

    Raises:
        ValueError: they are of different numbers of particles.
    """
    given = [field for field in fields if field is not None]
    if len(given) < 2:
        return given[0] if given else None
    counts = sorted({len(field) for field in given})
    if len(counts) > 1:
        raise ValueError(f"fields over {' and '.join(map(str, counts))} particles do not add up")
    total = np.zeros((counts[0], max(field.shape[1] for field in given)))
    for field in given:
        total[:, : field.shape[1]] += field
    return total


def carried(field: Array | None, sources: Array, targets: Array) -> Array | None:
    """A field (P, k) of particles at ``sources`` (P, 3) at ``targets`` (Q, 3): the nearest ones by inverse distance."""
    if field is None:
        return None
    distance, near = cKDTree(sources).query(targets, k=min(_NEIGHBOURS, len(sources)))
    distance, near = distance.reshape(len(targets), -1), near.reshape(len(targets), -1)
    weight = 1.0 / np.maximum(distance, 1e-9 * max(float(distance.max()), 1e-12)) ** 2
    moved: Array = np.einsum("qn,qnk->qk", weight / weight.sum(axis=1, keepdims=True), field[near])
    return moved
