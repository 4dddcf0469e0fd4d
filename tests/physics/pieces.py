"""Bodies in pieces: ropes or sheets of one lattice that do not hang together, so that they can be laid as one likes."""

from __future__ import annotations

import numpy as np

from physworld.mpm.lattice import Lattice, lattice_from_cells
from physworld.mpm.total_lagrangian import HeldNodes

_BETWEEN = 6  # cells of nothing between two pieces


def in_pieces(counts: tuple[tuple[int, ...], ...], dx: float) -> tuple[Lattice, list[np.ndarray]]:
    """A lattice of pieces of so many cells, one after another along its first axis, and the nodes of each."""
    cells, begins, begin = [], [], 0
    for count in counts:
        own = np.stack(np.meshgrid(*[np.arange(c) for c in count], indexing="ij"), axis=-1)
        cells.append(own.reshape(-1, len(count)) + np.eye(len(count), dtype=int)[0] * begin)
        begins.append(begin)
        begin += count[0] + _BETWEEN
    together = np.concatenate(cells)
    dim = together.shape[1]
    lattice = lattice_from_cells(np.zeros(dim), np.full(dim, dx), together, np.ones((len(together), 2**dim)))
    along = lattice.nodes[:, 0]
    own_nodes = [
        np.flatnonzero((along >= begin - 1) & (along <= begin + count[0]))
        for begin, count in zip(begins, counts, strict=True)
    ]
    return lattice, own_nodes


def laid(
    lattice: Lattice, pieces: list[np.ndarray], corners: np.ndarray, axes: list[np.ndarray]
) -> np.ndarray:
    """Nodes (n, 3) of undeformed pieces: each begins at its corner (3,) and lies along its unit axes (d, 3)."""
    nodes = np.zeros((len(lattice.nodes), 3))
    for own, corner, directions in zip(pieces, corners, axes, strict=True):
        local = lattice.node_coordinates[own]
        begin = np.zeros(lattice.dim)
        begin[0] = local[:, 0].min() + 0.5 * lattice.spacing[0]
        nodes[own] = corner + (local - begin) @ directions
    return nodes


def still(nodes: np.ndarray, places: np.ndarray, frames: int) -> HeldNodes:
    """Nodes held where they are; ``places`` (n, 3) [m]."""
    positions = np.repeat(places[nodes][None], frames, axis=0)
    return HeldNodes(nodes, positions, np.zeros_like(positions))


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
