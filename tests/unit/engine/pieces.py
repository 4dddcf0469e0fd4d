"""Bodies in pieces that can be laid as one likes, and how often a sheet passes through itself."""

from __future__ import annotations

import numpy as np

from benchmarks.verification.cases import hold as still
from benchmarks.verification.contact import in_pieces, laid
from physworld.engine.lattice.lattice import Lattice

__all__ = ["crossings", "in_pieces", "laid", "still"]


def crossings(lattice: Lattice, nodes: np.ndarray, apart_m: float) -> int:
    """How many edges of a rectangular sheet's half cells pass its triangles farther along it than ``apart_m``."""
    counts = 2 * (lattice.cells.max(axis=0) + 1)
    grid = np.stack(np.meshgrid(*[(np.arange(c) + 0.5) / 2 for c in counts], indexing="ij"), axis=-1)
    reference = grid.reshape(-1, 2) * lattice.spacing
    points = lattice.interpolation(reference) @ nodes
    number = np.arange(len(points)).reshape(counts)
    first = np.stack([number[:-1, :-1], number[1:, :-1], number[:-1, 1:]], axis=-1)
    second = np.stack([number[1:, 1:], number[:-1, 1:], number[1:, :-1]], axis=-1)
    triangles = np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)])
    a, b, c = (points[triangles[:, k]] for k in range(3))
    along, across = b - a, c - a
    edges = [
        np.stack([number[:-1], number[1:]], axis=-1),
        np.stack([number[:, :-1], number[:, 1:]], axis=-1),
    ]
    found = 0
    for i, j in np.concatenate([edge.reshape(-1, 2) for edge in edges]):
        way = points[j] - points[i]
        h = np.cross(way, across)
        volume = np.einsum("ij,ij->i", along, h)
        volume[np.abs(volume) < 1e-18] = np.inf
        from_corner = points[i] - a
        u = np.einsum("ij,ij->i", from_corner, h) / volume
        q = np.cross(from_corner, along)
        v = (q @ way) / volume
        t = np.einsum("ij,ij->i", across, q) / volume
        inside = (u > 0) & (v > 0) & (u + v < 1) & (t > 0) & (t < 1)
        far = np.linalg.norm(reference[i] - reference[triangles[:, 0]], axis=1) > apart_m
        found += int(np.sum(inside & far))
    return found
