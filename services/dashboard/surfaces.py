"""The surface of a model's body, for the 3D views: the twin's filled cells, carried by the vertices.

The twin of a solid lies on a lattice of cells, each in 2 × 2 × 2 parts that are filled with material or not. Faces
between filled and empty parts, smoothed after Taubin (1995), are the surface at rest; of a sheet it is the filled parts
themselves, two triangles each, seen from both sides. Each of its points hangs on the nearest ``CARRIERS`` vertices of
the graph; the browser turns and moves it with them (``frontend/src/surface.js``). Ropes are tubes (``tubes.py``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.thin.triangles import TriangleLattice
from physworld_services.dashboard.tubes import Tubes, body_tubes

CARRIERS, NEIGHBOURS = 4, 8
SMOOTHING = ((0.5, -0.53),) * 6
"""Steps of Taubin's smoothing: in and out again, which keeps the volume."""
FILLED = 1e-6
MOST_TRIANGLES = 40_000
CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])


@dataclass(frozen=True)
class Surface:
    """A body's surface at rest and what carries it.

    Attributes:
        points: (m, 3) [m].
        triangles: (t, 3), outward by the right hand.
        index: carrying vertices of each point, (m, CARRIERS).
        weight: of each of them, (m, CARRIERS), together 1.
        rest: the graph's vertices at rest [m], (n, 3).
        neighbours: of each vertex, by which its turn is known, (n, NEIGHBOURS).
    """

    points: Array
    triangles: Array
    index: Array
    weight: Array
    rest: Array
    neighbours: Array

    def document(self) -> dict[str, Any]:
        """The surface as JSON: flat lists, places to a tenth of a millimetre of a metre-sized body."""
        digits = max(4, 5 - int(np.floor(np.log10(max(float(np.ptp(self.rest)), 1e-6)))))
        return {
            "kind": "skin",
            "points": np.round(self.points, digits).ravel().tolist(),
            "triangles": self.triangles.ravel().tolist(),
            "index": self.index.ravel().tolist(),
            "weight": np.round(self.weight, 4).ravel().tolist(),
            "carriers": self.index.shape[1],
            "rest": np.round(self.rest, digits).ravel().tolist(),
            "neighbours": self.neighbours.ravel().tolist(),
        }


def body_surface(twin: Mapping[str, Array], rest: Array, particle_index: Array) -> Surface | Tubes | None:
    """What a twin's body looks like from outside; None of one without cells, or with too many of them.

    Args:
        twin: arrays of a stored twin.
        rest: the graph's vertices at rest [m], (n, 3).
        particle_index: number of the twin's particle that each vertex is, (n,).
    """
    cells, fill = (twin.get(name) for name in ("lattice_cells", "lattice_fill"))
    if cells is None or fill is None or cells.ndim != 2 or fill.shape != (len(cells), 2 ** cells.shape[1]):
        return None
    if cells.shape[1] == 1:
        return body_tubes(twin, particle_index)
    if cells.shape[1] == 2:
        points, triangles = sheet_surface(twin, fill > FILLED)
    else:
        points, triangles = cell_surface(
            cells, fill > FILLED, twin["lattice_origin"], twin["lattice_spacing"]
        )
    if not 0 < len(triangles) <= MOST_TRIANGLES or len(rest) <= NEIGHBOURS:
        return None
    from scipy.spatial import cKDTree  # half a second: not before somebody plays

    tree = cKDTree(rest)
    distance, index = tree.query(points, CARRIERS)
    weight = 1.0 / np.maximum(distance, 1e-3 * np.ptp(rest)) ** 2
    neighbours = tree.query(rest, NEIGHBOURS + 1)[1][:, 1:]
    return Surface(points, triangles, index, weight / weight.sum(axis=1, keepdims=True), rest, neighbours)


def sheet_surface(twin: Mapping[str, Array], filled: Array) -> tuple[Array, Array]:
    """Points (m, 3) [m] and triangles (t, 3) of a sheet at rest.

    Args:
        twin: arrays of a stored twin of a sheet.
        filled: which parts of its cells hold material, the last axis running fastest, (C, 4) bool.
    """
    of = TriangleLattice if "lattice_odd" in twin else Lattice
    lattice = of(**{field.name: twin[f"lattice_{field.name}"] for field in fields(of)})
    corners = CORNERS[:4, 1:]
    parts = (2 * lattice.cells[:, None, :] + corners)[filled]
    quads = parts[:, None, :] + corners
    places, inverse = np.unique(quads.reshape(-1, 2), axis=0, return_inverse=True)
    low, right, left, high = inverse.reshape(-1, 4)[:, [0, 2, 1, 3]].T
    triangles = np.concatenate([np.stack([low, right, high], axis=1), np.stack([low, high, left], axis=1)])
    points: Array = lattice.interpolation(lattice.origin + places * (lattice.spacing / 2)) @ twin["body_rest"]
    return points, triangles


def cell_surface(cells: Array, filled: Array, origin: Array, spacing: Array) -> tuple[Array, Array]:
    """Points (m, 3) [m] and triangles (t, 3) around the filled parts of cells.

    Args:
        cells: places of the cells in the lattice, (C, 3) int.
        filled: which of their parts hold material, the last axis running fastest, (C, 8) bool.
        origin, spacing: of the lattice [m], (3,).
    """
    parts = (2 * cells[:, None, :] + CORNERS)[filled]
    if not len(parts):
        return np.empty((0, 3)), np.empty((0, 3), dtype=int)
    low = parts.min(axis=0) - 1
    taken = np.zeros(parts.max(axis=0) - low + 2, dtype=bool)
    taken[tuple((parts - low).T)] = True
    corners = []
    for axis in range(3):
        u, v = ((axis + 1) % 3, (axis + 2) % 3)
        for side in (0, 1):
            bare = np.argwhere(taken & ~np.roll(taken, 1 - 2 * side, axis=axis))
            ring = np.zeros((4, 3), dtype=int)
            ring[:, axis] = side
            ring[:, u], ring[:, v] = (0, 1, 1, 0), (0, 0, 1, 1)
            corners.append(bare[:, None, :] + (ring if side else ring[::-1]))
    quads = np.concatenate(corners)
    places, inverse = np.unique(quads.reshape(-1, 3), axis=0, return_inverse=True)
    faces = inverse.reshape(-1, 4)
    triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    return _smoothed(origin + (places + low) * (spacing / 2), faces), triangles


def _smoothed(points: Array, faces: Array) -> Array:
    """The points after Taubin's smoothing along the edges of the faces (q, 4)."""
    edges = np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    ends = np.concatenate([edges, edges[:, ::-1]])
    count = np.bincount(ends[:, 0], minlength=len(points))[:, None]
    smooth = np.asarray(points, dtype=float)
    for step in SMOOTHING:
        for factor in step:
            total = np.zeros_like(smooth)
            np.add.at(total, ends[:, 0], smooth[ends[:, 1]])
            smooth = smooth + factor * (total / count - smooth)
    return smooth
