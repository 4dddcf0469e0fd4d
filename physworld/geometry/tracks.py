"""Measured points followed as material points of a body whose nodes move."""

from __future__ import annotations

from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.geometry.body import ReferenceBody
from physworld.geometry.rigid import least_rotation


def material_tracks(body: ReferenceBody, nodes: Array) -> Array:
    """Tracked points (T, N, 3) of the nodes' trajectories (T, n, 3) [m].

    Points beside a sheet's middle surface move along its normal, those beside a rope's centre line with its section.
    """
    lattice = body.lattice
    tracks = applied(lattice.interpolation(body.points), nodes)
    if lattice.dim == 2 and np.any(body.offsets):
        first = applied(lattice.interpolation(body.points, (1, 0)), nodes)
        second = applied(lattice.interpolation(body.points, (0, 1)), nodes)
        normal = np.cross(first, second)
        tracks = tracks + body.offsets * normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    elif lattice.dim == 1 and np.any(body.offsets):
        slope = lattice.interpolation(body.points, (1,))
        turn = least_rotation((slope @ body.start)[None], applied(slope, nodes))
        tracks = tracks + np.einsum("tnij,nj->tni", turn, body.offsets)
    return tracks


def applied(matrix: Any, nodes: Array) -> Array:
    """Sparse (M, n) times trajectories (T, n, 3): (T, M, 3)."""
    frames, n, _ = nodes.shape
    flat = matrix @ nodes.transpose(1, 0, 2).reshape(n, -1)
    return np.asarray(flat).reshape(matrix.shape[0], frames, 3).transpose(1, 0, 2)
