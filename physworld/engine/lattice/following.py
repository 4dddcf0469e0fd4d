"""Tracked points carried by particles: affine motion of the particles around them, as long as those stay together.

A point moves with the least-squares affine map of its nearest particles, from where it was attached:

    x(t) = m(t) + A(t) (x0 - m0)        A = argmin sum |A (p_i(t0) - m0) - (p_i(t) - m(t))|^2

which is exact for a body that stretches and turns, also for a marker beside it. Where its particles part or shear away
from one another (the fit leaves more than a quarter of their distance) the point is attached anew, to the particles
that are nearest then, at the place it has: in material that has flowed a point is followed, not interpolated.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from physworld.arrays import Array

_NEIGHBOURS = 12  # a cell and a half of a full lattice: enough for an affine map on a surface
_PARTED = 0.25  # misfit of the affine map, in mean distances of the particles, that attaches a point anew
_THIN = 1e-4  # share of the largest spread below which the particles lie on a plane or line


def follow(points: Array, particles: Array) -> Array:
    """Paths (T, N, 3) [m] of ``points`` (N, 3), given at the first frame, among ``particles`` (T, P, 3).

    Raises:
        ValueError: there are fewer than 4 particles.
    """
    if particles.shape[1] < 4:
        raise ValueError(f"an affine motion needs at least 4 particles, got {particles.shape[1]}")
    count = min(_NEIGHBOURS, particles.shape[1])
    paths = np.empty((len(particles), len(points), 3))
    paths[0] = points
    near, anchors, frames = (
        _attach(points, particles[0], count),
        points.copy(),
        np.zeros(len(points), dtype=int),
    )
    for frame in range(1, len(particles)):
        paths[frame], misfit = _carry(anchors, particles[frames[:, None], near], particles[frame][near])
        parted = misfit > _PARTED
        if parted.any():
            before = paths[frame - 1, parted]
            near[parted] = _attach(before, particles[frame - 1], count)
            anchors[parted], frames[parted] = before, frame - 1
            fresh = near[parted]
            paths[frame, parted], _ = _carry(before, particles[frame - 1][fresh], particles[frame][fresh])
    return paths


def _attach(points: Array, particles: Array, count: int) -> Array:
    return np.asarray(cKDTree(particles).query(points, k=count)[1]).reshape(len(points), count)


def _carry(points: Array, before: Array, after: Array) -> tuple[Array, Array]:
    """Places (N, 3) of ``points`` after their neighbours (N, K, 3) moved, and the misfit of the affine map (N,)."""
    middle, moved = before.mean(axis=1), after.mean(axis=1)
    X, Y = before - middle[:, None], after - moved[:, None]
    spread = np.einsum("nki,nkj->nij", X, X)
    values, axes = np.linalg.eigh(spread)
    seen = values > _THIN * values[:, -1:]
    inverse = np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0)
    across = np.einsum("nki,nkj->nij", Y, X)
    A = across @ np.einsum("nij,nj,nkj->nik", axes, inverse, axes)
    # directions that the neighbours do not span: carried along by the rotation, so that a marker keeps its distance
    hidden = np.einsum("nij,nj,nkj->nik", axes, (~seen).astype(float), axes)
    A = A + _rotation(A) @ hidden
    left = Y - np.einsum("nij,nkj->nki", A, X)
    size = np.sqrt(np.einsum("nki,nki->n", X, X) / X.shape[1])
    misfit = np.sqrt(np.einsum("nki,nki->n", left, left) / X.shape[1])
    return moved + np.einsum("nij,nj->ni", A, points - middle), misfit / size


def _rotation(A: Array) -> Array:
    """Nearest rotation to each matrix (N, 3, 3)."""
    U, _, Vt = np.linalg.svd(A)
    flip = np.ones((len(A), 3))
    flip[:, 2] = np.linalg.det(U @ Vt)
    nearest: Array = (U * flip[:, None, :]) @ Vt
    return nearest
