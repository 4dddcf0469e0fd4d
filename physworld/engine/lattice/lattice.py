"""The reference lattice: cells, nodes and particles of an undeformed body of dimension 1, 2 or 3.

A solid is meshed in space, a sheet over its two in-plane coordinates, a rod over its arc length: the same quadratic
B-splines in each case (:mod:`physworld.engine.lattice.bspline`). Only cells that hold material exist; a particle's fill
is the share of its quarter, eighth … of the cell that material occupies (finite cell method, Parvizian et al. 2007).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from physworld.arrays import Array
from physworld.engine.lattice.bspline import gauss_points, local_offsets, tensor_weights


@dataclass(frozen=True)
class Lattice:
    """Cells that hold material, and the nodes that they see.

    Attributes:
        origin: reference coordinates of cell (0, 0, …)'s lower corner [m], (d,).
        spacing: cell size [m], (d,).
        cells: integer cell coordinates, (C, d).
        fill: share of material at every particle, (C, 2**d), in [0, 1].
        cell_nodes: node numbers of every cell, (C, 3**d) int32.
        nodes: integer node coordinates, (n, d); node i sits at origin + (i + 1/2) spacing.
    """

    origin: Array
    spacing: Array
    cells: Array
    fill: Array
    cell_nodes: Array
    nodes: Array
    smooth: ClassVar[bool] = True
    """Whether its field has slopes without jumps, as splines do: what strains and curvatures of cells are made from."""

    @property
    def dim(self) -> int:
        """1 for a rod, 2 for a sheet, 3 for a solid."""
        return int(self.cells.shape[1])

    @property
    def title(self) -> str:
        """For people."""
        return f"a body of {len(self.cells)} cells of splines"

    @property
    def node_coordinates(self) -> Array:
        """Reference coordinates of the nodes [m], (n, d)."""
        coordinates: Array = self.origin + (self.nodes + 0.5) * self.spacing
        return coordinates

    @property
    def particle_coordinates(self) -> Array:
        """Reference coordinates of the particles [m], (C * 2**d, d), a cell's particles side by side."""
        local = gauss_points(self.dim)
        coordinates: Array = (self.origin + (self.cells[:, None, :] + local[None]) * self.spacing).reshape(
            -1, self.dim
        )
        return coordinates

    @property
    def particle_measures(self) -> Array:
        """Length, area or volume that each particle stands for [m**d], (C * 2**d,)."""
        measures: Array = (self.fill * (np.prod(self.spacing) / 2**self.dim)).reshape(-1)
        return measures

    def lumped(self, particle_mass: Array) -> Array:
        """Lumped nodal masses [kg], (n,), of particles (P,): rows of the mass matrix summed."""
        per_cell = particle_mass.reshape(len(self.cells), -1) @ self.table((0,) * self.dim).T
        mass = np.zeros(len(self.nodes))
        np.add.at(mass, self.cell_nodes, per_cell)
        return mass

    def table(self, orders: tuple[int, ...]) -> Array:
        """Weights of a cell's nodes at its particles, differentiated in units of the cell, (3**d, 2**d)."""
        return np.ascontiguousarray(tensor_weights(gauss_points(self.dim), orders).T)

    def interpolation(self, coordinates: Array, orders: tuple[int, ...] | None = None) -> sparse.csr_matrix:
        """Matrix (M, n) that takes nodal values to the values at material ``coordinates`` (M, d).

        Outside the material the field of the nearest cell is continued linearly: a marker on a stalk moves as if it
        were glued to the body. With ``orders`` the matrix gives that derivative [1/m**order], without continuation.
        """
        coordinates = np.asarray(coordinates, dtype=float).reshape(-1, self.dim)
        cell, local = self._locate(coordinates)
        clipped = np.clip(local, 0.0, 1.0)
        if orders is not None:
            weights = tensor_weights(clipped, orders) / np.prod(self.spacing ** np.array(orders))
        else:
            weights = tensor_weights(clipped, (0,) * self.dim)
            for axis in range(self.dim):
                slope = tensor_weights(clipped, tuple(int(a == axis) for a in range(self.dim)))
                weights = weights + slope * (local - clipped)[:, axis, None]
        rows = np.repeat(np.arange(len(coordinates)), weights.shape[1])
        shape = (len(coordinates), len(self.nodes))
        return sparse.csr_matrix((weights.ravel(), (rows, self.cell_nodes[cell].ravel())), shape=shape)

    def second_differences(self) -> sparse.csr_matrix:
        """Matrix (D, n) of x_(i-1) - 2 x_i + x_(i+1) over every three nodes in a row: zero for affine fields only."""
        number = {tuple(node): k for k, node in enumerate(self.nodes.tolist())}
        triples = []
        for axis in range(self.dim):
            step = np.eye(self.dim, dtype=int)[axis]
            for k, node in enumerate(self.nodes):
                before, after = (
                    number.get(tuple((node - step).tolist())),
                    number.get(tuple((node + step).tolist())),
                )
                if before is not None and after is not None:
                    triples.append((before, k, after))
        columns = np.array(triples).ravel()
        rows = np.repeat(np.arange(len(triples)), 3)
        values = np.tile([1.0, -2.0, 1.0], len(triples))
        return sparse.csr_matrix((values, (rows, columns)), shape=(len(triples), len(self.nodes)))

    def outside(self, coordinates: Array) -> Array:
        """Distance of material ``coordinates`` (M, d) from the nearest cell that holds material [m], (M,)."""
        _, local = self._locate(np.asarray(coordinates, dtype=float).reshape(-1, self.dim))
        distance: Array = np.linalg.norm((local - np.clip(local, 0.0, 1.0)) * self.spacing, axis=1)
        return distance

    def _locate(self, coordinates: Array) -> tuple[Array, Array]:
        """Nearest cell (by distance to its box, among the nearest centres) and local coordinates there."""
        scaled = (coordinates - self.origin) / self.spacing
        neighbours = min(3**self.dim, len(self.cells))
        _, near = cKDTree(self.cells + 0.5).query(scaled, k=neighbours)
        near = near.reshape(len(coordinates), neighbours)
        local = scaled[:, None, :] - self.cells[near]
        gap = np.linalg.norm((local - np.clip(local, 0.0, 1.0)) * self.spacing, axis=2)
        best = np.argmin(gap, axis=1)
        pick = np.arange(len(coordinates))
        return near[pick, best], local[pick, best]


def lattice_from_cells(origin: Array, spacing: Array, cells: Array, fill: Array) -> Lattice:
    """Number the nodes of the given cells.

    Args:
        origin: reference coordinates of the corner of cell 0 [m], (d,).
        spacing: size of the cells [m], (d,).
        cells: integer places of the cells, (C, d).
        fill: share of every particle's part of its cell that holds material, (C, 2**d).

    Raises:
        ValueError: there is no cell, or a fill lies outside [0, 1].
    """
    cells = np.asarray(cells, dtype=np.int64)
    dim = cells.shape[1]
    if len(cells) == 0:
        raise ValueError("a lattice needs at least one cell with material, got 0")
    if fill.shape != (len(cells), 2**dim) or fill.min() < 0 or fill.max() > 1:
        raise ValueError(
            f"fill must be ({len(cells)}, {2**dim}) in [0, 1], got {fill.shape}, up to {fill.max()}"
        )
    touched = (cells[:, None, :] + local_offsets(dim)[None]).reshape(-1, dim)
    nodes, inverse = np.unique(touched, axis=0, return_inverse=True)
    return Lattice(
        origin=np.asarray(origin, dtype=float),
        spacing=np.asarray(spacing, dtype=float),
        cells=cells,
        fill=np.asarray(fill, dtype=float),
        cell_nodes=inverse.reshape(len(cells), 3**dim).astype(np.int32),
        nodes=nodes,
    )


def box_lattice(origin: Array, size: Array, counts: tuple[int, ...]) -> Lattice:
    """A full box of ``counts`` cells: every face of the body lies on a cell face."""
    counts_array = np.asarray(counts)
    cells = np.stack(np.meshgrid(*[np.arange(c) for c in counts], indexing="ij"), axis=-1).reshape(
        -1, len(counts)
    )
    fill = np.ones((len(cells), 2 ** len(counts)))
    return lattice_from_cells(origin, np.asarray(size, dtype=float) / counts_array, cells, fill)
