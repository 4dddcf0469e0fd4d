"""Ropes, rods and cables as tubes, for the 3D views: centre lines that are carried by the graph's vertices.

The vertices of a rod have material coordinates, its arc length. Between them a centre line is the cubic whose slopes
are central differences, beyond the outermost ones it goes straight on to the end of the rod. A branch begins where it
leaves the line before it. Each place of a line is thus a weighted sum of a few vertices; the browser adds them up and
lays rings around (``frontend/src/tube.js``).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.rods.chain import Chain

PLACES_A_SPAN, MOST_PLACES = 6, 800
SMALLEST = 1e-6
"""Weight below which a vertex carries nothing."""
THINNEST = 2e-3
"""Radius over the length of the rod, below which a tube would be thinner than a pixel and is drawn thicker."""


@dataclass(frozen=True)
class Tubes:
    """Centre lines and what carries them.

    Attributes:
        lines: places of each line, together m.
        index: carrying vertices of each place, (m, k).
        weight: of each of them, (m, k), together 1; some are negative.
        radius_m: of the tubes [m].
    """

    lines: tuple[int, ...]
    index: Array
    weight: Array
    radius_m: float

    def document(self) -> dict[str, Any]:
        """The tubes as JSON: flat lists."""
        return {
            "kind": "tube",
            "lines": list(self.lines),
            "index": self.index.ravel().tolist(),
            "weight": np.round(self.weight, 5).ravel().tolist(),
            "carriers": self.index.shape[1],
            "radius": self.radius_m,
        }


@dataclass(frozen=True)
class _Line:
    """A stretch of a rod without a branch in it, by material coordinates.

    Attributes:
        low, high: where it begins and ends [m].
        vertices: the graph's vertices on it, (n,).
        leaves: number of the line that it branches off, None of the cable itself.
        at: where on that line [m].
    """

    low: float
    high: float
    vertices: Array
    leaves: int | None = None
    at: float = 0.0


def body_tubes(twin: Mapping[str, Array], particle_index: Array) -> Tubes | None:
    """The tubes of a rod's twin whose graph has the particles ``particle_index`` (n,) as its vertices.

    None where no line has two vertices.

    Args:
        twin: arrays of a stored twin of a rod.
        particle_index: number of the particle that each vertex is, (n,).
    """
    of = Chain if "lattice_parent" in twin else Lattice
    lattice = of(**{field.name: twin[f"lattice_{field.name}"] for field in fields(of)})
    coordinates = lattice.particle_coordinates[particle_index, 0]
    curves: list[_Curve] = []
    for line in _lines(lattice, particle_index):
        order = line.vertices[np.argsort(coordinates[line.vertices])]
        knots, arcs = np.eye(len(particle_index))[order], coordinates[order]
        if line.leaves is not None and len(curves[line.leaves].arcs):
            knots = np.concatenate([curves[line.leaves].at(np.array([line.at])), knots])
            arcs = np.concatenate([[line.low], arcs])
        curves.append(_Curve(knots, arcs, line.low, line.high))
    weights = [curve.drawn() for curve in curves if len(curve.arcs) > 1]
    if not weights:
        return None
    whole = np.concatenate(weights)
    carriers = int((np.abs(whole) > SMALLEST).sum(axis=1).max())
    index = np.argsort(-np.abs(whole), axis=1, kind="stable")[:, :carriers]
    length_m = float(lattice.particle_measures.sum())
    radius_m = max(float(json.loads(str(twin["facts"]))["thickness_m"]), THINNEST * length_m)
    counts = tuple(len(part) for part in weights)
    return Tubes(counts, index, np.take_along_axis(whole, index, axis=1), radius_m)


@dataclass(frozen=True)
class _Curve:
    """A centre line as weights of all the graph's vertices (n,).

    Attributes:
        knots: weights of the places that it runs through, (k, n).
        arcs: their material coordinates, rising [m], (k,).
        low, high: where it begins and ends [m].
    """

    knots: Array
    arcs: Array
    low: float
    high: float

    def at(self, places: Array) -> Array:
        """Weights at material coordinates ``places`` (m,) [m], (m, n); of one knot it is the knot everywhere."""
        from scipy.interpolate import CubicHermiteSpline  # not before somebody looks

        if len(self.arcs) < 2:
            return np.repeat(self.knots, len(places), axis=0)
        inside = np.clip(places, self.arcs[0], self.arcs[-1])
        slopes = np.gradient(self.knots, self.arcs, axis=0)
        end = np.where((places > inside)[:, None], slopes[-1], slopes[0])
        weights: Array = CubicHermiteSpline(self.arcs, self.knots, slopes)(inside)
        weights += (places - inside)[:, None] * end
        return weights

    def drawn(self) -> Array:
        """Weights at the places that are drawn, from end to end, (m, n)."""
        ends = min(self.low, self.arcs[0]), max(self.high, self.arcs[-1])
        return self.at(np.linspace(*ends, min(PLACES_A_SPAN * len(self.arcs), MOST_PLACES)))


def _lines(lattice: Lattice, particle_index: Array) -> list[_Line]:
    """The cable and its branches, each after the one that it leaves."""
    if not isinstance(lattice, Chain):
        low, high = (
            float(lattice.origin[0] + end * lattice.spacing[0])
            for end in (lattice.cells.min(), lattice.cells.max() + 1)
        )
        return [_Line(low, high, np.arange(len(particle_index)))]
    places = lattice.node_coordinates[:, 0]
    begins = np.zeros(len(places), dtype=int)
    begins[lattice.branches] = 1
    line_of_node = np.cumsum(begins)
    line_of_vertex = line_of_node[
        particle_index // 2 + 1
    ]  # two particles an edge, which is named by its last node
    found = []
    for line in range(int(line_of_node[-1]) + 1):
        nodes = np.flatnonzero(line_of_node[1:] == line) + 1
        parent = int(lattice.parent[nodes[0]])
        found.append(
            _Line(
                low=float(lattice.begins[nodes[0] - 1]),
                high=float(places[nodes[-1]]),
                vertices=np.flatnonzero(line_of_vertex == line),
                leaves=int(line_of_node[parent]) if line else None,
                at=float(places[parent]),
            )
        )
    return found
