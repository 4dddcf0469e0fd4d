"""The reference body of a discrete rod: nodes along one curve, or along a cable and its branches.

Nodes are numbered so that a parent comes before its children; cell c is the edge from the parent of node c + 1 to it.
The material coordinate is the arc length from the first node; a branch goes on from where the cable, or the branch
before it, ends, so that a coordinate names one place only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from scipy import sparse

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.errors import SceneUnsupported

_QUARTERS = np.array([0.25, 0.75])


@dataclass(frozen=True)
class Chain(Lattice):
    """A polyline without a ring; see the module's text.

    Attributes:
        parent: node before each node, (n,) int32; -1 of the first.
        lengths: of the edge that ends at each node [m], (n,); 0 of the first.
    """

    parent: Array
    lengths: Array
    smooth: ClassVar[bool] = False

    @cached_property
    def begins(self) -> Array:
        """Material coordinate at which every edge begins [m], (n - 1,)."""
        begins, ends = np.zeros(len(self.parent)), np.zeros(len(self.parent))
        last = 0.0
        for node in range(1, len(self.parent)):
            goes_on = self.parent[node] == node - 1
            begins[node] = ends[node - 1] if goes_on else last
            ends[node] = begins[node] + self.lengths[node]
            last = ends[node]
        return begins[1:]

    @property
    def title(self) -> str:
        """For people."""
        return f"a discrete rod of {len(self.cells)} edges"

    @property
    def node_coordinates(self) -> Array:
        """Material coordinates of the nodes [m], (n, 1)."""
        return np.concatenate([[0.0], self.begins + self.lengths[1:]])[:, None]

    @property
    def particle_coordinates(self) -> Array:
        """Material coordinates of the particles [m], two an edge, (2 (n - 1), 1)."""
        places: Array = (self.begins[:, None] + _QUARTERS * self.lengths[1:, None]).reshape(-1, 1)
        return places

    @property
    def particle_measures(self) -> Array:
        """Length that each particle stands for [m], (2 (n - 1),)."""
        measures: Array = (self.fill * 0.5 * self.lengths[1:, None]).reshape(-1)
        return measures

    @property
    def branches(self) -> Array:
        """Nodes at the end of the first edge of every branch, (b,)."""
        nodes: Array = np.flatnonzero(self.parent[1:] != np.arange(len(self.parent) - 1)) + 1
        return nodes

    @cached_property
    def distances(self) -> Array:
        """Distance of every node from the first one along the rod [m], (n,)."""
        away = np.zeros(len(self.parent))
        for node in range(1, len(self.parent)):
            away[node] = away[self.parent[node]] + self.lengths[node]
        return away

    @cached_property
    def joint_lengths(self) -> Array:
        """Length that the joint at the parent of each node stands for [m], (n,); 0 where there is none."""
        lengths = np.zeros(len(self.parent))
        bent = np.flatnonzero(self.parent > 0)
        lengths[bent] = 0.5 * (self.lengths[bent] + self.lengths[self.parent[bent]])
        return lengths

    def modes(self, count: int) -> Array:
        """The smoothest fields over the edges, the constant one first, (n, count), each of amplitude 1.

        Eigenvectors of the second difference over joints: of one rope, the cosines of its length.
        """
        vectors = self._smooth_first[:, :count]
        found = np.zeros((len(self.parent), vectors.shape[1]))
        found[1:] = vectors
        return found

    @cached_property
    def _smooth_first(self) -> Array:
        """All of :meth:`modes`, without the first node, (n - 1, n - 1)."""
        nodes = np.arange(1, len(self.parent))
        bent = nodes[self.parent[1:] > 0]
        stiffness = np.zeros((len(nodes), len(nodes)))
        for node in bent:
            pair = np.array([self.parent[node], node]) - 1
            stiffness[np.ix_(pair, pair)] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / self.joint_lengths[node]
        root = np.sqrt(self.lengths[1:])
        _, vectors = np.linalg.eigh(stiffness / np.outer(root, root))
        vectors = vectors / root[:, None]
        vectors = vectors / np.abs(vectors).max(axis=0)
        signed: Array = vectors * np.where(vectors[0] < 0.0, -1.0, 1.0)
        return signed

    def table(self, orders: tuple[int, ...]) -> Array:
        """None: what an edge's ends weigh are no splines.

        Raises:
            SceneUnsupported: always; it names the rod.
        """
        raise SceneUnsupported(
            f"weights of orders {orders} shared by all {len(self.cells)} edges of a discrete rod: there are none; this "
            "needs a rod of splines (formulation total_lagrangian)"
        )

    def lumped(self, particle_mass: Array) -> Array:
        """Lumped nodal masses [kg], (n,): half of every edge at either end."""
        share = 0.5 * particle_mass.reshape(len(self.cells), -1).sum(axis=1)
        mass = np.zeros(len(self.nodes))
        np.add.at(mass, self.cell_nodes, share[:, None])
        return mass

    def interpolation(self, coordinates: Array, orders: tuple[int, ...] | None = None) -> sparse.csr_matrix:
        """As :meth:`Lattice.interpolation`, linear along every edge; of derivatives the first one only."""
        coordinates = np.asarray(coordinates, dtype=float).reshape(-1)
        ends = self.begins + self.lengths[1:]
        gap = np.maximum(self.begins - coordinates[:, None], coordinates[:, None] - ends)
        edge = np.argmin(np.maximum(gap, 0.0), axis=1)
        length = self.lengths[1:][edge]
        if orders is None or not any(orders):
            share = (coordinates - self.begins[edge]) / length
            weights = np.stack([1.0 - share, share], axis=1)
        elif sum(orders) == 1:
            weights = np.stack([-1.0 / length, 1.0 / length], axis=1)
        else:
            raise SceneUnsupported(f"second derivatives {orders} of a field that is linear along edges")
        rows = np.repeat(np.arange(len(coordinates)), 2)
        shape = (len(coordinates), len(self.nodes))
        return sparse.csr_matrix((weights.ravel(), (rows, self.cell_nodes[edge].ravel())), shape=shape)

    def second_differences(self) -> sparse.csr_matrix:
        """Matrix (D, n) of x_grandparent - 2 x_parent + x_node at every joint."""
        bent = np.flatnonzero(self.parent > 0)
        middle = self.parent[bent]
        columns = np.stack([self.parent[middle], middle, bent], axis=1).ravel()
        rows = np.repeat(np.arange(len(bent)), 3)
        values = np.tile([1.0, -2.0, 1.0], len(bent))
        return sparse.csr_matrix((values, (rows, columns)), shape=(len(bent), len(self.parent)))

    def outside(self, coordinates: Array) -> Array:
        """Distance of material ``coordinates`` (M, 1) from the nearest edge [m], (M,)."""
        places = np.asarray(coordinates, dtype=float).reshape(-1, 1)
        gap = np.maximum(self.begins - places, places - self.begins - self.lengths[1:])
        distance: Array = np.maximum(gap, 0.0).min(axis=1)
        return distance


def chain(parent: Array, lengths: Array) -> Chain:
    """The chain of these edges.

    Args:
        parent: node before each node, (n,); -1 of the first, and always a smaller number than the node's own.
        lengths: of the edge that ends at each node [m], (n,); that of the first is not read.

    Raises:
        ValueError: fewer than two edges, a length that is not positive, more than one edge at the first node, or a
            parent that does not come before its child.
    """
    parent, lengths = np.asarray(parent, dtype=np.int32), np.asarray(lengths, dtype=float).copy()
    lengths[0] = 0.0
    count = len(parent)
    if count < 3 or not np.all(lengths[1:] > 0.0):
        raise ValueError(
            f"a rod of {count - 1} edges between {lengths[1:].min(initial=0.0):.3g} m and longer"
        )
    if parent[0] != -1 or np.any(parent[1:] < 0) or np.any(parent[1:] >= np.arange(1, count)):
        raise ValueError(
            f"node before each of {count} nodes: {parent.tolist()}; each must come before its node"
        )
    if np.sum(parent == 0) != 1:
        raise ValueError(f"{int(np.sum(parent == 0))} edges begin at the first node; a rod begins with one")
    edges = np.arange(count - 1)
    return Chain(
        origin=np.zeros(1),
        spacing=np.array([float(lengths[1:].mean())]),
        cells=edges[:, None],
        fill=np.ones((count - 1, 2)),
        cell_nodes=np.stack([parent[1:], edges + 1], axis=1).astype(np.int32),
        nodes=np.arange(count)[:, None],
        parent=parent,
        lengths=lengths,
    )
