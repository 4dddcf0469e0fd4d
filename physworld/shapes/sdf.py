"""Signed distances of rigid shapes: negative inside, in the shape's own frame [m].

Primitives have closed forms; a closed mesh is sampled once on a grid of equal spacing and interpolated trilinearly.
Its distances are those of the mesh within half the square of the spacing over the radius of curvature, and its edges
are rounded by about half a spacing. The same functions run on the device (:mod:`physworld.shapes.sdf_kernels`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.devices import default_device
from physworld.errors import SceneUnsupported
from physworld.shapes import sdf_kernels as kernels
from physworld.shapes.surface_mesh import SurfaceMesh, require_closed

_MESH_CELLS = 64  # grid cells along the longest side of a mesh
_MARGIN_CELLS = 3  # beyond the mesh, plus what the body's thickness asks


@dataclass(frozen=True, eq=False)
class Shape:
    """A rigid shape.

    Attributes:
        kind: a constant of :mod:`physworld.shapes.sdf_kernels`.
        size: its numbers there, (3,).
        inner_m: depth of its deepest inside point [m]; a body that came deeper has come through.
        reach_m: distance of its farthest point from the origin of its frame [m].
        values: samples, (I, J, K) float32; a single zero for a primitive.
        low, spacing_m: place of the first sample, (3,) [m], and the grid's spacing [m].
    """

    kind: int
    size: Array
    inner_m: float
    reach_m: float
    values: Array
    low: Array
    spacing_m: float

    @property
    def exact(self) -> bool:
        """Whether its distances are true ones: they change by no more than a point moves."""
        return self.kind != kernels.SAMPLED

    def distance(self, points: Array) -> Array:
        """Signed distances [m], (M,), at ``points`` (M, 3) [m]; far outside of a sampled grid 1e6 m."""
        return self._evaluate(points)[:, 3]

    def normal(self, points: Array) -> Array:
        """Outward unit normals (M, 3) of the level sets through ``points`` (M, 3) [m]."""
        gradient = self._evaluate(points)[:, :3]
        normals: Array = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-30)
        return normals

    def on_device(self, device: str) -> list[Any]:
        """Leading arguments of :func:`physworld.shapes.sdf_kernels.signed_distance`."""
        return [
            self.kind,
            wp.vec3d(*self.size),
            wp.array(self.values, dtype=wp.float32, device=device),
            wp.vec3d(*self.low),
            wp.vec3d(*np.full(3, 1.0 / self.spacing_m)),
        ]

    def _evaluate(self, points: Array) -> Array:
        points = np.ascontiguousarray(np.asarray(points, dtype=float).reshape(-1, 3))
        found = wp.zeros(len(points), dtype=wp.vec4d, device="cpu")
        inputs = [*self.on_device("cpu"), wp.array(points, dtype=wp.vec3d, device="cpu")]
        wp.launch(kernels.evaluate, dim=len(points), inputs=inputs, outputs=[found], device="cpu")
        values: Array = found.numpy()
        return values


def sphere(radius_m: float) -> Shape:
    """Ball about the origin."""
    return _primitive(kernels.SPHERE, (radius_m, 0.0, 0.0), radius_m, radius_m)


def box(size_m: Array | tuple[float, float, float]) -> Shape:
    """Box of sides ``size_m`` about the origin."""
    half = 0.5 * np.asarray(size_m, dtype=float)
    return _primitive(kernels.BOX, half, float(half.min()), float(np.linalg.norm(half)))


def capsule(radius_m: float, length_m: float) -> Shape:
    """Points within ``radius_m`` of a segment of ``length_m`` along z about the origin."""
    return _primitive(kernels.CAPSULE, (radius_m, 0.5 * length_m, 0.0), radius_m, radius_m + 0.5 * length_m)


def cylinder(radius_m: float, length_m: float) -> Shape:
    """Cylinder of ``length_m`` along z about the origin."""
    half = 0.5 * length_m
    return _primitive(
        kernels.CYLINDER, (radius_m, half, 0.0), min(radius_m, half), float(np.hypot(radius_m, half))
    )


def half_space() -> Shape:
    """Everything at z <= 0."""
    return Shape(
        kernels.HALF_SPACE, np.ones(3), np.inf, 0.0, np.zeros((1, 1, 1), dtype=np.float32), np.zeros(3), 1.0
    )


def mesh_shape(
    mesh: SurfaceMesh, margin_m: float = 0.0, cells: int = _MESH_CELLS, device: str | None = None
) -> Shape:
    """Sampled distances to a closed mesh; a :class:`trimesh.Trimesh` has the same ``vertices`` and ``faces``.

    Args:
        mesh: the boundary, in the shape's own frame.
        margin_m: how far outside distances are wanted [m]: the thickness of what touches it.
        cells: grid cells along the mesh's longest side.
        device: where the samples are computed.

    Raises:
        SceneUnsupported: the mesh is not closed, or thinner than the grid can show.
    """
    device = device or default_device()
    mesh = require_closed(
        SurfaceMesh(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)), "a shape"
    )
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    spacing = float((high - low).max()) / cells
    low = low - margin_m - _MARGIN_CELLS * spacing
    counts = np.ceil((high + margin_m + _MARGIN_CELLS * spacing - low) / spacing).astype(int) + 1
    centre = 0.5 * (mesh.vertices.min(axis=0) + high)
    surface = wp.Mesh(
        points=wp.array((mesh.vertices - centre).astype(np.float32), dtype=wp.vec3f, device=device),
        indices=wp.array(mesh.faces.reshape(-1).astype(np.int32), dtype=wp.int32, device=device),
    )
    values = wp.zeros(tuple(counts), dtype=wp.float32, device=device)
    inputs = [surface.id, wp.vec3f(*(low - centre)), spacing]
    wp.launch(kernels.sample_mesh, dim=tuple(counts), inputs=inputs, outputs=[values], device=device)
    samples = values.numpy()
    inner = -float(samples.min())
    if inner < spacing:
        raise SceneUnsupported(
            f"a mesh of {np.round(mesh.size_m, 6)} m is at most {2 * inner:.3g} m thick, less than two of the "
            f"{cells} grid cells of {spacing:.3g} m along its longest side"
        )
    reach = float(np.linalg.norm(mesh.vertices, axis=1).max())
    return Shape(kernels.SAMPLED, np.zeros(3), inner, reach, samples, low, spacing)


def _primitive(kind: int, size: Any, inner: float, reach: float) -> Shape:
    numbers = np.asarray(size, dtype=float)
    if not (np.isfinite(numbers).all() and inner > 0 and (numbers >= 0).all()):
        raise SceneUnsupported(f"a shape of sizes {numbers} m has no volume")
    return Shape(kind, numbers, inner, reach, np.zeros((1, 1, 1), dtype=np.float32), np.zeros(3), 1.0)
