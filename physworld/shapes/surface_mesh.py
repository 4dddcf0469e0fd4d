"""Closed triangle meshes of rigid tools, and what makes one unfit to be the boundary of a volume."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.errors import SceneUnsupported


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles that bound a rigid body.

    Attributes:
        vertices: (V, 3) float64 [m], in the body's own frame.
        faces: (F, 3) int64, counter-clockwise seen from outside.
    """

    vertices: Array
    faces: Array

    @property
    def size_m(self) -> Array:
        """Extents of the bounding box [m], (3,)."""
        size: Array = np.ptp(self.vertices, axis=0)
        return size

    @property
    def volume_m3(self) -> float:
        """Enclosed volume [m^3], by the divergence theorem; negative where the faces look inwards."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return float(np.sum(a * np.cross(b, c)) / 6.0)

    @property
    def unmatched_edges(self) -> int:
        """Directed edges without exactly one neighbour that runs the other way: 0 for a watertight mesh."""
        edges = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]])
        there, back = (_edge_numbers(edges, len(self.vertices)) for edges in (edges, edges[:, ::-1]))
        names, counts = np.unique(there, return_counts=True)
        single = np.isin(there, names[counts == 1])
        return int((~(single & np.isin(back, there))).sum())

    def fault(self) -> str | None:
        """Why the mesh bounds no volume, with the numbers; None where it does."""
        if not len(self.faces):
            return "has no faces"
        if not np.isfinite(self.vertices).all():
            return f"has {int((~np.isfinite(self.vertices)).any(axis=1).sum())} vertices that are not finite"
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            return f"names vertices {self.faces.min()} to {self.faces.max()}, there are {len(self.vertices)}"
        if self.unmatched_edges:
            return (
                f"is not watertight: {self.unmatched_edges} of {3 * len(self.faces)} edges have no neighbour that runs "
                "the other way"
            )
        if not self.volume_m3 > 1e-9 * float(np.prod(self.size_m)):
            return f"encloses {self.volume_m3:.3g} m3 in a box of {np.prod(self.size_m):.3g} m3"
        return None


def merged(vertices: Array, faces: Array) -> SurfaceMesh:
    """The mesh with equal vertices made one, faces without area dropped, and faces turned to look outwards.

    Applied to its own result it changes nothing, bit for bit.
    """
    places, number = np.unique(np.asarray(vertices, dtype=np.float64) + 0.0, axis=0, return_inverse=True)
    faces = number.reshape(-1)[np.asarray(faces, dtype=np.int64)]
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    mesh = SurfaceMesh(places, faces[distinct])
    return SurfaceMesh(places, mesh.faces[:, [0, 2, 1]]) if mesh.volume_m3 < 0 else mesh


def require_closed(mesh: SurfaceMesh, name: str) -> SurfaceMesh:
    """The mesh itself.

    Raises:
        SceneUnsupported: it bounds no volume.
    """
    fault = mesh.fault()
    if fault is not None:
        raise SceneUnsupported(f"the mesh of {name} {fault}")
    return mesh


def _edge_numbers(edges: Array, vertices: int) -> Array:
    return edges[:, 0] * vertices + edges[:, 1]
