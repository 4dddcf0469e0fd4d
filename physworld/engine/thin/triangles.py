"""A sheet as other engines compute it: a mesh of linear triangles whose edges bend like hinges.

What a recording by such an engine shows is the motion of its mesh, and no refinement of ours comes to it: meshes of
some 16 cells a side part from their own refinements by several millimetres (``docs/calibration.md``). Cells are cut by
diagonals that alternate, nodes sit at their corners, and each carries a third of every triangle at it.

    W = A / 2 N : e           in every triangle, e and N as in :mod:`physworld.materials.sheet`
    W = D / (2 A_e) |sum_i c_i x_i|^2      at every inner edge, A_e the area of its two triangles

c are sums of the cotangents at the edge (Bergou, Wardetzky, Harmon, Zorin, Grinspun 2006, "A quadratic bending model
for inextensible surfaces"; they take 3 / A_e, MuJoCo 1 / A_e).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from scipy import sparse

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.errors import SceneUnsupported

MESH_TEXT = r"([1-9]\d{0,2})x([1-9]\d{0,2})(odd)?"


@dataclass(frozen=True)
class Mesh:
    """Cells along the two sides of a sheet, and whether the first one's diagonal starts at its second corner."""

    counts: tuple[int, int]
    odd: bool = False

    @classmethod
    def read(cls, text: str) -> Mesh:
        """A mesh as people write it: "16x15", or "16x15odd".

        Raises:
            ValueError: the text is none.
        """
        found = re.fullmatch(MESH_TEXT, text)
        if found is None:
            raise ValueError(f'a mesh is written as 16x15, or 16x15odd; this is "{text}"')
        return cls((int(found[1]), int(found[2])), found[3] is not None)

    def __str__(self) -> str:
        cut = ", the first cut the other way" if self.odd else ""
        return f"{self.counts[0]} x {self.counts[1]} cells of two triangles{cut}"


@dataclass(frozen=True)
class TriangleLattice(Lattice):
    """Nodes at the corners of cells, a linear field in each triangle; see the module's text.

    Attributes:
        odd: whether cell (0, 0) is cut from (1, 0) to (0, 1) instead of from (0, 0) to (1, 1).
        cell_nodes: corners (0, 0), (0, 1), (1, 0), (1, 1) of every cell, (C, 4).
    """

    odd: bool = False
    smooth: ClassVar[bool] = False

    @property
    def title(self) -> str:
        """For people."""
        return f"a mesh of {len(self.cells)} cells of triangles"

    @property
    def node_coordinates(self) -> Array:
        """Reference coordinates of the nodes [m], (n, 2)."""
        coordinates: Array = self.origin + self.nodes * self.spacing
        return coordinates

    def table(self, orders: tuple[int, ...]) -> Array:
        """None: what a cell's corners weigh differs from cell to cell.

        Raises:
            SceneUnsupported: always; it names the mesh.
        """
        raise SceneUnsupported(
            f"weights of orders {orders} shared by all {len(self.cells)} cells of a mesh of triangles: there are none; "
            "this needs a sheet of splines"
        )

    def lumped(self, particle_mass: Array) -> Array:
        """Lumped nodal masses [kg], (n,): a third of every triangle, which weighs half a cell."""
        share = particle_mass.reshape(len(self.cells), -1).sum(axis=1) / 6.0
        mass = np.zeros(len(self.nodes))
        np.add.at(mass, self.triangles, np.repeat(share, 2)[:, None])
        return mass

    def interpolation(self, coordinates: Array, orders: tuple[int, ...] | None = None) -> sparse.csr_matrix:
        """As :meth:`Lattice.interpolation`, of the triangle at each place; of derivatives the first ones only."""
        coordinates = np.asarray(coordinates, dtype=float).reshape(-1, 2)
        cell, local = self._locate(coordinates)
        weights = self._weights(cell, local)
        if orders is not None and any(orders):
            if sum(orders) > 1:
                raise SceneUnsupported(f"second derivatives {orders} of a field that is linear in triangles")
            axis = int(np.argmax(orders))
            step = np.eye(2)[axis]
            inside = np.clip(local, 0.0, 1.0)
            ahead = self._weights(cell, local + step, inside)
            weights = (ahead - self._weights(cell, local, inside)) / self.spacing[axis]
        rows = np.repeat(np.arange(len(coordinates)), 4)
        shape = (len(coordinates), len(self.nodes))
        return sparse.csr_matrix((weights.ravel(), (rows, self.cell_nodes[cell].ravel())), shape=shape)

    @property
    def mesh(self) -> Mesh:
        """Its cells and diagonals."""
        across, up = (int(n) + 1 for n in self.cells.max(axis=0))
        return Mesh((across, up), self.odd)

    def crossed(self, cell: Array) -> Array:
        """Which of the cells (M,) are cut from (1, 0) to (0, 1), (M,) bool."""
        odd: Array = (self.cells[cell].sum(axis=1) + int(self.odd)) % 2 == 1
        return odd

    def _weights(self, cell: Array, local: Array, within: Array | None = None) -> Array:
        """Of the corners (M, 4) at ``local`` (M, 2), linear from the triangle that holds ``within`` on."""
        u, v = local.T
        a, b = (np.clip(local, 0.0, 1.0) if within is None else within).T
        zero = np.zeros_like(u)
        lower = np.stack([1 - u, zero, u - v, v], axis=1)
        upper = np.stack([1 - v, v - u, zero, u], axis=1)
        straight = np.where((b <= a)[:, None], lower, upper)
        near = np.stack([1 - u - v, v, u, zero], axis=1)
        far = np.stack([zero, 1 - u, 1 - v, u + v - 1], axis=1)
        across = np.where((a + b <= 1)[:, None], near, far)
        return np.where(self.crossed(cell)[:, None], across, straight)

    @cached_property
    def triangles(self) -> Array:
        """Nodes of the triangles, two a cell side by side, (2 C, 3) int32, counter-clockwise in the plane."""
        low, left, right, high = self.cell_nodes.T  # corners (0, 0), (0, 1), (1, 0), (1, 1)
        straight = np.stack([low, right, high, low, high, left], axis=1)
        across = np.stack([low, right, left, right, high, left], axis=1)
        crossed = self.crossed(np.arange(len(self.cells)))[:, None]
        return np.where(crossed, across, straight).reshape(-1, 3).astype(np.int32)

    @cached_property
    def areas(self) -> Array:
        """Of the triangles [m^2], (2 C,)."""
        return np.full(len(self.triangles), 0.5 * float(np.prod(self.spacing)))

    @cached_property
    def slopes(self) -> Array:
        """Derivatives of the corners' weights along both axes [1/m], (2 C, 3, 2)."""
        places = self.node_coordinates[self.triangles]
        return np.stack(
            [_turned(places[:, (k + 2) % 3] - places[:, (k + 1) % 3]) for k in range(3)], axis=1
        ) / (2.0 * self.areas[:, None, None])

    @cached_property
    def hinges(self) -> tuple[Array, Array, Array]:
        """Ends of the inner edges and the corners opposite, (H, 4) int32; cotangent weights c, (H, 4); areas (H,)."""
        corners = np.array([(*ends, *(corner for corner, _ in sides)) for ends, sides in self._inner])
        corners = corners.reshape(-1, 4).astype(np.int32)
        first, second, one, other = np.moveaxis(self.node_coordinates[corners], 1, 0)
        at_first = _cotangent(first, second, one), _cotangent(first, second, other)
        at_second = _cotangent(second, first, one), _cotangent(second, first, other)
        weights = np.stack(
            [sum(at_second), sum(at_first), -at_first[0] - at_second[0], -at_first[1] - at_second[1]], axis=1
        )
        return corners, weights, np.full(len(corners), float(np.prod(self.spacing)))

    @property
    def hinge_cells(self) -> Array:
        """The cells of the two triangles at every inner edge, (H, 2)."""
        return np.array([[cell for _, cell in sides] for _, sides in self._inner]).reshape(-1, 2)

    @cached_property
    def _inner(self) -> list[tuple[tuple[int, int], list[tuple[int, int]]]]:
        """Ends of every inner edge, and on either side of it the corner opposite and the cell."""
        sides: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for number, triangle in enumerate(self.triangles.tolist()):
            for k in range(3):
                ends = triangle[k], triangle[(k + 1) % 3]
                sides.setdefault((min(ends), max(ends)), []).append((triangle[(k + 2) % 3], number // 2))
        return [(ends, found) for ends, found in sides.items() if len(found) == 2]


def mesh_of(lattice: Lattice) -> Mesh | None:
    """The mesh that a lattice is; None of splines."""
    return lattice.mesh if isinstance(lattice, TriangleLattice) else None


def triangle_lattice(size: Array, mesh: Mesh, origin: Array | None = None) -> TriangleLattice:
    """The mesh of a sheet from ``origin`` (2,), by default (0, 0), over ``size`` (2,) [m].

    Raises:
        ValueError: fewer than one cell along a side.
    """
    counts = np.array(mesh.counts)
    if counts.min() < 1:
        raise ValueError(f"a mesh of {mesh.counts} cells has none along a side")
    cells = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 2)
    nodes = np.stack(np.meshgrid(*[np.arange(n + 1) for n in counts], indexing="ij"), axis=-1).reshape(-1, 2)
    corners = cells[:, None, :] + np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    return TriangleLattice(
        origin=np.zeros(2) if origin is None else np.asarray(origin, dtype=float),
        spacing=np.asarray(size, dtype=float) / counts,
        cells=cells,
        fill=np.ones((len(cells), 4)),
        cell_nodes=(corners @ [counts[1] + 1, 1]).astype(np.int32),
        nodes=nodes,
        odd=mesh.odd,
    )


def _turned(edges: Array) -> Array:
    """Plane vectors (M, 2) turned to the left by a right angle."""
    return np.stack([-edges[:, 1], edges[:, 0]], axis=1)


def _cotangent(at: Array, one: Array, other: Array) -> Array:
    """Of the angles at places (M, 2) between two others, (M,)."""
    u, v = one - at, other - at
    cotangents: Array = np.sum(u * v, axis=1) / np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    return cotangents
