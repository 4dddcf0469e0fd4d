"""From the motion of graph vertices to the motion of any material point.

Two ways:

* **Affine weights**, for tracked points: every point is a fixed combination of its K nearest vertices, p = Σ w_k x_k,
  with Σ w_k = 1 and, as well as the neighbourhood allows, Σ w_k x_k = p where the weights are made. Among all such
  weights the ones closest to 1/distance are taken. It is exact for every affine motion of the neighbourhood,
  needs no rotation, and is linear: differentiable for free, in numpy or torch.
* **Linear blend skinning** as in the paper's appendix, for what also needs an orientation (3D Gaussians): weights
  1/distance, each vertex moved by its translation and by the rotation that fits its neighbourhood best
  (Kabsch), quaternions blended after their signs are made to agree, which published code forgets.

Shapes: M points, n vertices, K neighbours; positions in metres. Quaternions (w, x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

RIDGE = 1e-3  # of the fit's own scale: how far weights may leave 1/distance to meet an offset the plane lacks
DISTANCE_FLOOR = 1e-3  # of the neighbourhood's size: a point that is a vertex


@dataclass(frozen=True)
class Skin:
    """Vertices ``index`` (M, K) that carry each point, and their ``weight`` (M, K), rows summing to 1."""

    index: np.ndarray
    weight: np.ndarray

    def apply(self, vertices: np.ndarray) -> np.ndarray:
        """Points (…, M, 3) of vertices (…, n, 3)."""
        return np.einsum("mk,...mkx->...mx", self.weight, np.asarray(vertices)[..., self.index, :])

    def apply_torch(self, vertices: Tensor) -> Tensor:
        """The same, differentiable."""
        weight = torch.as_tensor(self.weight, dtype=vertices.dtype, device=vertices.device)
        moved = vertices[..., torch.as_tensor(self.index, device=vertices.device), :]
        return (weight[..., None] * moved).sum(dim=-2)


def nearest_vertices(points: np.ndarray, vertices: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices (M, K) of the nearest vertices and their distances [m], nearest first."""
    distance = np.linalg.norm(points[:, None] - vertices[None], axis=2)
    index = np.argsort(distance, axis=1, kind="stable")[:, : min(count, vertices.shape[0])]
    return index, np.take_along_axis(distance, index, axis=1)


def inverse_distance_weights(distance: np.ndarray) -> np.ndarray:
    """w ∝ 1/distance, rows summing to 1, (M, K)."""
    floor = DISTANCE_FLOOR * distance[:, -1:] + np.finfo(np.float64).tiny
    weight = 1.0 / np.maximum(distance, floor)
    return weight / weight.sum(axis=1, keepdims=True)


def affine_skin(points: np.ndarray, vertices: np.ndarray, neighbours: int = 8) -> Skin:
    """Weights that reproduce affine motions; both arguments in the same, preferably undeformed, state."""
    index, distance = nearest_vertices(points, vertices, neighbours)
    prior = inverse_distance_weights(distance)
    offset = vertices[index] - points[:, None]
    scale = np.maximum(distance[:, -1], np.finfo(np.float64).tiny)
    offset = offset / scale[:, None, None]
    # Least change of the prior, weighted by the prior itself, that removes Σ w_k offset_k while Σ w_k stays 1.
    centred = offset - np.einsum("mk,mkx->mx", prior, offset)[:, None]
    spread = np.einsum("mk,mkx,mky->mxy", prior, centred, centred)
    missing = np.einsum("mk,mkx->mx", prior, offset)
    ridge = RIDGE * np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
    slope = np.linalg.solve(spread + ridge, missing[..., None])[..., 0]
    weight = prior * (1.0 - np.einsum("mkx,mx->mk", centred, slope))
    return Skin(index, weight / weight.sum(axis=1, keepdims=True))


def local_rotations(rest: np.ndarray, moved: np.ndarray, neighbours: int = 8) -> np.ndarray:
    """Rotation of every vertex's neighbourhood, (…, n, 3, 3): argmin_R Σ_j ‖R (rest_j − rest_i) − (moved_j − moved_i)‖².

    ``rest`` (n, 3), ``moved`` (…, n, 3). Neighbourhoods on a line leave the turn about it free: it is then
    whatever the singular vectors give, and harmless for points near the line.
    """
    index, _ = nearest_vertices(rest, rest, neighbours + 1)
    index = index[:, 1:]
    before = rest[index] - rest[:, None]
    after = moved[..., index, :] - moved[..., :, None, :]
    covariance = np.einsum("...nkx,nky->...nxy", after, before)
    left, _, right = np.linalg.svd(covariance)
    flip = np.ones((*covariance.shape[:-1],))
    flip[..., 2] = np.sign(np.linalg.det(left @ right))
    return (left * flip[..., None, :]) @ right


def linear_blend(
    points: np.ndarray,
    rest: np.ndarray,
    moved: np.ndarray,
    *,
    neighbours: int = 8,
    quaternions: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Move points, and their orientations, with the vertices (paper, appendix 3D Gaussian Update Through LBS).

    Args:
        points: (M, 3) in the rest state.
        rest, moved: vertices at rest (n, 3) and moved (n, 3).
        quaternions: orientations at rest (M, 4), or None.

    Returns:
        Moved points (M, 3) and orientations (M, 4), or None.
    """
    index, distance = nearest_vertices(points, rest, neighbours)
    weight = inverse_distance_weights(distance)
    rotation = local_rotations(rest, moved, neighbours)
    carried = np.einsum("mkxy,mky->mkx", rotation[index], points[:, None] - rest[index]) + moved[index]
    positions = np.einsum("mk,mkx->mx", weight, carried)
    if quaternions is None:
        return positions, None
    turns = quaternion_of(rotation)[index]
    agree = np.sign(np.einsum("mkq,mq->mk", turns, turns[:, 0]))
    blended = np.einsum("mk,mkq->mq", weight * np.where(agree == 0.0, 1.0, agree), turns)
    blended /= np.linalg.norm(blended, axis=1, keepdims=True)
    return positions, quaternion_product(blended, quaternions)


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternions (…, 4) with w ≥ 0 of rotation matrices (…, 3, 3), stable at every angle."""
    r = rotation
    trace = np.trace(r, axis1=-2, axis2=-1)
    diagonal = np.diagonal(r, axis1=-2, axis2=-1)
    square = np.stack([1.0 + trace, *(1.0 + 2.0 * diagonal[..., k] - trace for k in range(3))], axis=-1)
    x, y, z = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    # Row b holds 4 q_b q: the row of the largest component is the accurate one.
    rows = np.stack(
        [
            np.stack([square[..., 0], x, y, z], axis=-1),
            np.stack([x, square[..., 1], xy, xz], axis=-1),
            np.stack([y, xy, square[..., 2], yz], axis=-1),
            np.stack([z, xz, yz, square[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(square, axis=-1)
    quaternion = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)


def quaternion_product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Hamilton product (…, 4): the turn ``right`` followed by ``left``."""
    w, v = left[..., :1], left[..., 1:]
    w2, v2 = right[..., :1], right[..., 1:]
    return np.concatenate(
        [w * w2 - (v * v2).sum(axis=-1, keepdims=True), w * v2 + w2 * v + np.cross(v, v2)], axis=-1
    )
