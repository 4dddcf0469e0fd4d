"""From the motion of graph vertices to the motion of any material point.

Two ways:

* **Affine weights**, for tracked points: every point is a fixed combination of its K nearest vertices,
  p = Σ w_k x_k with Σ w_k = 1, that minimises over the states s at hand
      Σ_s |Σ_k w_k x_k^s - p^s|² + λ Σ_k (w_k - v_k)² / v_k,        v ∝ 1/distance.
  With one state it is exact for every affine motion of a neighbourhood that spans space; with several it
  also learns what a line or a sheet of vertices hides. It needs no rotation and is linear. A marker on a cloth, or a
  point on the skin of a rope, lies beside the middle surface or the centre line that the vertices are of, and turns
  with it (:class:`Beside`), which no such combination does.
* **Linear blend skinning** as in the paper's appendix, for what also needs an orientation (3D Gaussians):
  weights 1/distance, each vertex moved by its translation and by the rotation that fits its neighbourhood
  best (Kabsch), quaternions blended after their signs are made to agree, which published code forgets.

Shapes: M points, n vertices, K neighbours; positions in metres. Quaternions (w, x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from physworld.arrays import Array
from physworld.geometry.rigid import least_rotation

RIDGE = 1e-4  # λ in units of the neighbourhood's mean square size: keeps weights near 1/distance where free
DISTANCE_FLOOR = 1e-3  # of the neighbourhood's size: a point that is a vertex
ON_A_LINE = 1e-6  # of the neighbourhood's spread along it: rounding across a line, not a shape
GAPS_AT_ONCE = 2**19  # pairs of a point and a vertex that are looked at together: some 60 MiB
STRAIGHT = 1e-3  # second over first singular value of rest vertices on a line
OPPOSITE = 1e-3  # least 1 + cosine of a rope's turn: a line that is turned round has no least turn
SHORTEST = 1e-12  # of a direction: shorter ones are none
LEAST_TURN = 1e-8  # of the same: weight of turning as little as may be


@dataclass(frozen=True)
class Beside:
    """Where points lie beside a sheet or a rope, in directions that go along with it.

    u = Σ_k slope_1k x_k and v = Σ_k slope_2k x_k are material directions at the point. Beside a sheet it is at its
    height along u × v / |u × v|; beside a rope (v = 0) its offset is turned as the least turn takes ``line`` to u.

    Attributes:
        slope: (2, M, K) [1/m], sums over K of 0; the second is 0 beside a rope.
        offset: (M, 3) [m]: beside a sheet its last component is the height, the others are 0; beside a rope in world
            axes where u is along ``line``.
        line: (M, 3), 0 beside a sheet.
    """

    slope: Array
    offset: Array
    line: Array

    def shift(self, along: Tensor, across: Tensor) -> Tensor:
        """The offsets (…, M, 3) [m] of directions u and v (…, M, 3)."""
        offset, line = (
            torch.as_tensor(a, dtype=along.dtype, device=along.device) for a in (self.offset, self.line)
        )
        if not np.any(self.line):
            normal = torch.linalg.cross(along, across)
            raised: Tensor = offset[:, 2:] * _unit(normal)
            return raised
        along = _unit(along)
        line, offset = line.expand_as(along), offset.expand_as(along)
        axis = torch.linalg.cross(line, along)
        once = torch.linalg.cross(axis, offset)
        near = (1.0 + (line * along).sum(dim=-1, keepdim=True)).clamp(min=OPPOSITE)
        turned: Tensor = offset + once + torch.linalg.cross(axis, once) / near
        return turned


@dataclass(frozen=True)
class Skin:
    """Vertices ``index`` (M, K) that carry each point, and their ``weight`` (M, K), rows summing to 1.

    ``beside``: where the points lie beside what the vertices are of; None: in it.
    """

    index: Array
    weight: Array
    beside: Beside | None = None

    def apply(self, vertices: Array) -> Array:
        """Points (…, M, 3) of vertices (…, n, 3)."""
        vertices = np.asarray(vertices)
        points = _combined(self.weight, self.index, vertices)
        if self.beside is not None:
            slopes = (torch.from_numpy(_combined(a, self.index, vertices)) for a in self.beside.slope)
            points += self.beside.shift(*slopes).numpy()
        return points

    def apply_torch(self, vertices: Tensor) -> Tensor:
        """The same, differentiable."""
        moved = vertices[..., torch.as_tensor(self.index, device=vertices.device), :]

        def combined(weight: Array) -> Tensor:
            own = torch.as_tensor(weight, dtype=vertices.dtype, device=vertices.device)
            return (own[..., None] * moved).sum(dim=-2)

        points = combined(self.weight)
        if self.beside is not None:
            points = points + self.beside.shift(*(combined(part) for part in self.beside.slope))
        return points


def _unit(vectors: Tensor) -> Tensor:
    """Unit vectors (…, 3); 0 of a neighbourhood that has collapsed, which has no direction."""
    found: Tensor = vectors / torch.linalg.vector_norm(vectors, dim=-1, keepdim=True).clamp(min=SHORTEST)
    return found


def _combined(weight: Array, index: Array, vertices: Array) -> Array:
    """Σ_k weight_k x_k (…, M, 3), one neighbour at a time: all at once take K times the memory."""
    total: Array = weight[:, :1] * vertices[..., index[:, 0], :]
    for k in range(1, index.shape[1]):
        total += weight[:, k, None] * vertices[..., index[:, k], :]
    return total


def nearest_vertices(points: Array, vertices: Array, count: int) -> tuple[Array, Array]:
    """Indices (M, K) of the nearest vertices and their distances [m], nearest first."""
    rows = max(1, GAPS_AT_ONCE // max(1, len(vertices)))
    parts = []
    for first in range(0, max(1, len(points)), rows):
        distance = np.linalg.norm(points[first : first + rows, None] - vertices[None], axis=2)
        index = np.argsort(distance, axis=1, kind="stable")[:, : min(count, vertices.shape[0])]
        parts.append((index, np.take_along_axis(distance, index, axis=1)))
    indices, distances = zip(*parts, strict=True)
    return np.concatenate(indices), np.concatenate(distances)


def inverse_distance_weights(distance: Array) -> Array:
    """w ∝ 1/distance, rows summing to 1, (M, K)."""
    floor = DISTANCE_FLOOR * distance[:, -1:] + np.finfo(np.float64).tiny
    weight = 1.0 / np.maximum(distance, floor)
    normalised: Array = weight / weight.sum(axis=1, keepdims=True)
    return normalised


def affine_skin(points: Array, vertices: Array, neighbours: int = 8) -> Skin:
    """Weights from one state, points (M, 3) and vertices (n, 3), or from several, (S, M, 3) and (S, n, 3).

    Neighbours are the nearest in the first state.
    """
    points, vertices = points.reshape(-1, *points.shape[-2:]), vertices.reshape(-1, *vertices.shape[-2:])
    index, distance = nearest_vertices(points[0], vertices[0], neighbours)
    prior = inverse_distance_weights(distance)
    offset = vertices[:, index] - points[:, :, None]
    gram = np.einsum("smkx,smlx->mkl", offset, offset)
    scale = np.trace(gram, axis1=1, axis2=2) / index.shape[1] + np.finfo(np.float64).tiny
    penalty = np.eye(index.shape[1]) / prior[:, None]
    # The minimum under Σ w = 1: (G + λ diag(1/v)) w is the same in every component.
    system = gram / scale[:, None, None] + RIDGE * penalty
    weight = np.linalg.solve(system, np.ones((*index.shape, 1)))[..., 0]
    return Skin(index, weight / weight.sum(axis=1, keepdims=True))


def skin_beside(skin: Skin, points: Array, vertices: Array, rest: Array) -> Skin:
    """The skin with the offsets that points (S, M, 3) have from where it carries them, as the mean over the states.

    Args:
        skin: of the places in the sheet or rope beside which the points lie.
        points: in the states at hand, (S, M, 3) [m].
        vertices: in the same, (S, n, 3) [m].
        rest: vertices of the undeformed body (n, 3) [m], on a line or in a plane.
    """
    reach = rest[skin.index] - skin.apply(rest)[:, None]
    near = inverse_distance_weights(np.linalg.norm(reach, axis=2))
    reach = reach - np.einsum("mk,mkx->mx", near, reach)[:, None]
    spread, axes = np.linalg.eigh(np.einsum("mk,mkx,mky->mxy", near, reach, reach))
    spread = np.maximum(spread, np.finfo(np.float64).tiny)
    slope = np.einsum("mk,mkx,mxj->jmk", near, reach, axes[:, :, :0:-1]) / spread[:, :0:-1].T[..., None]
    sizes = np.linalg.svd(rest - rest.mean(axis=0), compute_uv=False)
    line = np.zeros(points.shape[1:])
    if sizes[1] <= STRAIGHT * sizes[0]:
        slope[1] = 0.0
        line = _combined(slope[0], skin.index, vertices[0])
        line /= np.linalg.norm(line, axis=1, keepdims=True)
    along, across = (_combined(part, skin.index, vertices) for part in slope)
    left = points - skin.apply(vertices)
    if np.any(line):
        offset = np.einsum("smji,smj->mi", least_rotation(line, along), left) / len(left)
    else:
        normal = np.cross(along, across)
        normal /= np.linalg.norm(normal, axis=2, keepdims=True)
        offset = np.einsum("smx,smx->m", normal, left)[:, None] / len(left) * np.array([0.0, 0.0, 1.0])
    return replace(skin, beside=Beside(slope, offset, line))


def neighbourhoods(rest: Array, neighbours: int = 8) -> Array:
    """Indices (n, K) of every vertex's nearest others in the state ``rest`` (n, 3)."""
    return nearest_vertices(rest, rest, neighbours + 1)[0][:, 1:]


def local_rotations(rest: Array, moved: Array, neighbours: int = 8, *, index: Array | None = None) -> Array:
    """Rotation of every vertex's neighbourhood, (…, n, 3, 3): argmin_R Σ_j ‖R (rest_j − rest_i) − (moved_j
    − moved_i)‖².

    Neighbourhoods on a line leave the turn about it free: it is then the least rotation that turns the line.

    Args:
        rest: vertices at rest (n, 3) [m].
        moved: the same vertices later (…, n, 3) [m].
        neighbours: how many make a neighbourhood.
        index: the ``neighbourhoods`` (n, K), where they are known already.
    """
    index = neighbourhoods(rest, neighbours) if index is None else index
    before = rest[index] - rest[:, None]
    after = moved[..., index, :] - moved[..., :, None, :]
    covariance = np.einsum("...nkx,nky->...nxy", after, before)
    left, spread, right = np.linalg.svd(covariance)
    line = spread[..., 1] <= ON_A_LINE * spread[..., 0]
    if line.any():
        along = left[line, :, :1] @ right[line, :1]
        left[line], _, right[line] = np.linalg.svd(along + LEAST_TURN * np.eye(3))
    flip = np.ones((*covariance.shape[:-1],))
    flip[..., 2] = np.sign(np.linalg.det(left @ right))
    rotations: Array = (left * flip[..., None, :]) @ right
    return rotations


def quaternion_of(rotation: Array) -> Array:
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
    quaternion: Array = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)


def quaternion_product(left: Array, right: Array) -> Array:
    """Hamilton product (…, 4): the turn ``right`` followed by ``left``."""
    w, v = left[..., :1], left[..., 1:]
    w2, v2 = right[..., :1], right[..., 1:]
    return np.concatenate(
        [w * w2 - (v * v2).sum(axis=-1, keepdims=True), w * v2 + w2 * v + np.cross(v, v2)], axis=-1
    )
