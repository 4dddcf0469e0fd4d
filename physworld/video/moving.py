"""Gaussians carried by vertices: linear blend skinning (paper, appendix "3D Gaussian Update Through LBS").

Every Gaussian moves with its nearest vertices, weights 1/distance: each vertex has its translation and the rotation
that fits its neighbourhood best (Kabsch), and the Gaussian's own rotation is the blend of the quaternions. Its scales
stay, as in the paper; what it shows is turned with it, by looking at its harmonics from its own frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.video.gaussians import Gaussians
from physworld.worldmodel.model.skinning import (
    inverse_distance_weights,
    local_rotations,
    neighbourhoods,
    quaternion_of,
    quaternion_product,
)


class GaussianCarrier:
    """A splat bound to vertices at rest.

    Args:
        gaussians: the splat of the object at rest, in the vertices' frame.
        rest: vertices (n, 3) in the same state [m].
        neighbours: vertices that carry a Gaussian.

    Raises:
        ValueError: fewer than 2 vertices, or a splat so far from them that it cannot be theirs.
    """

    def __init__(self, gaussians: Gaussians, rest: Array, neighbours: int = 8) -> None:
        self.gaussians, self.rest = gaussians, np.asarray(rest, dtype=np.float64)
        if self.rest.ndim != 2 or self.rest.shape[1] != 3 or len(self.rest) < 2:
            raise ValueError(f"at least 2 vertices of shape (n, 3) carry a splat, got {self.rest.shape}")
        distance, index = cKDTree(self.rest).query(gaussians.means, k=min(neighbours, len(self.rest)))
        size = float(np.linalg.norm(np.ptp(self.rest, axis=0)))
        if np.median(distance[:, 0]) > size:
            raise ValueError(
                f"half of the Gaussians are more than {np.median(distance[:, 0]):.3g} m from the vertices, whose "
                f"extent is {size:.3g} m: is the splat in another frame or unit?"
            )
        self._around = neighbourhoods(self.rest, min(neighbours, len(self.rest) - 1))
        self.index, self.weight = index, inverse_distance_weights(distance)
        self._pulls = csr_matrix(
            (self.weight.ravel(), index.ravel(), np.arange(len(index) + 1) * index.shape[1]),
            shape=(len(index), len(self.rest)),
        )

    def at(self, moved: Array) -> tuple[Gaussians, Array]:
        """The splat when the vertices are at ``moved`` (n, 3), and what each Gaussian was turned by, (G, 4).

        Raises:
            ValueError: another number of vertices, or places that are not finite.
        """
        moved = np.asarray(moved, dtype=np.float64)
        if moved.shape != self.rest.shape or not np.isfinite(moved).all():
            raise ValueError(f"vertices must be finite and of shape {self.rest.shape}, got {moved.shape}")
        rotation = local_rotations(self.rest, moved, index=self._around)
        # sum_k w_k (R_k (p - x_k) + y_k), as one affine map a Gaussian
        shift = moved - np.einsum("nxy,ny->nx", rotation, self.rest)
        maps = (self._pulls @ np.concatenate([rotation.reshape(-1, 9), shift], axis=1)).reshape(-1, 12)
        means = np.einsum("mxy,my->mx", maps[:, :9].reshape(-1, 3, 3), self.gaussians.means) + maps[:, 9:]
        turns = quaternion_of(rotation)[self.index]
        agree = np.where(np.einsum("mkq,mq->mk", turns, turns[:, 0]) < 0.0, -1.0, 1.0)
        turn = np.einsum("mk,mkq->mq", self.weight * agree, turns)
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
        return replace(
            self.gaussians,
            means=means,
            rotations=quaternion_product(turn, self.gaussians.rotations),
        ), turn
