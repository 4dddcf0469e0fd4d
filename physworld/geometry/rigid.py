"""Rigid motions of marker groups, and which controllers move together.

A group of three or more markers that do not lie on a line carries a full pose; two markers carry the least rotation
that turns their direction (twist about it is not measured); one carries a translation.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from physworld.arrays import Array

_COLLINEAR = 1e-3  # second singular value below this share of the first: the markers lie on a line
_RIGID_STRAIN = 0.05  # distances within a gripper vary by less than this share (standard deviation)


def least_rotation(start: Array, goal: Array) -> Array:
    """Rotation of least angle that takes the directions ``start`` to ``goal``, both (..., 3): (..., 3, 3)."""
    a = start / np.linalg.norm(start, axis=-1, keepdims=True)
    b = goal / np.linalg.norm(goal, axis=-1, keepdims=True)
    a, b = np.broadcast_arrays(a, b)
    axis = np.cross(a, b)
    cosine = np.clip(np.sum(a * b, axis=-1), -1.0, 1.0)[..., None, None]
    skew = _skew(axis)
    rotation: Array = np.eye(3) + skew + skew @ skew / np.maximum(1.0 + cosine, 1e-9)
    flipped = cosine[..., 0, 0] < -1.0 + 1e-9
    if np.any(flipped):
        normal = np.cross(a[flipped], np.eye(3)[np.argmin(np.abs(a[flipped]), axis=-1)])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        rotation[flipped] = 2 * normal[..., :, None] * normal[..., None, :] - np.eye(3)
    return rotation


def rigid_motion(reference: Array, tracks: Array) -> tuple[Array, Array]:
    """Rotation and translation that carry ``reference`` to each frame of ``tracks`` in the least-squares sense.

    Args:
        reference: (k, 3) [m].
        tracks: (T, k, 3) [m].

    Returns:
        rotations (T, 3, 3) and translations (T, 3) with x_t = R_t x_0 + d_t.
    """
    centre, centres = reference.mean(axis=0), tracks.mean(axis=1)
    local, moved = reference - centre, tracks - centres[:, None]
    singular = np.linalg.svd(local, compute_uv=False) if len(reference) > 1 else np.zeros(3)
    if len(reference) == 1 or singular[0] < 1e-9:
        rotations = np.repeat(np.eye(3)[None], len(tracks), axis=0)
    elif len(reference) == 2 or singular[1] < _COLLINEAR * singular[0]:
        far = int(np.argmax(np.linalg.norm(local, axis=1)))
        rotations = least_rotation(local[far], moved[:, far])
    else:
        u, _, vt = np.linalg.svd(np.einsum("tki,kj->tij", moved, local))
        sign = np.sign(np.linalg.det(u @ vt))
        u[:, :, 2] *= sign[:, None]
        rotations = u @ vt
    return rotations, centres - rotations @ centre


def rigid_groups(tracks: Array, reach_m: float) -> list[Array]:
    """Controllers that keep their distances and lie within ``reach_m`` of each other: one gripper each.

    Args:
        tracks: (T, K, 3) [m].
        reach_m: markers of one gripper are linked over at most this distance.

    Returns:
        index arrays, in the order of their first controller.
    """
    if tracks.shape[1] == 0:
        return []
    distance = np.linalg.norm(tracks[:, :, None] - tracks[:, None, :], axis=-1)
    mean = distance.mean(axis=0)
    spread = distance.std(axis=0)
    linked = (mean <= reach_m) & (spread <= _RIGID_STRAIN * np.maximum(mean, 1e-6))
    groups, labels = connected_components(csr_matrix(linked), directed=False)
    members = [np.flatnonzero(labels == g) for g in range(groups)]
    return sorted(members, key=lambda m: int(m[0]))


def _skew(v: Array) -> Array:
    zero = np.zeros_like(v[..., 0])
    rows = [[zero, -v[..., 2], v[..., 1]], [v[..., 2], zero, -v[..., 0]], [-v[..., 1], v[..., 0], zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
