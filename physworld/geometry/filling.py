"""From points to volume: is a place inside the body that a point cloud fills or bounds?

Points that fill a body: an alpha shape, the Delaunay tetrahedra whose circumsphere is no larger than a few point
distances (Edelsbrunner, Muecke 1994), and half a point distance around the points, for the skin that they leave.
Points that only bound it: a voxel shell, closed and filled; an open surface stays a shell one voxel thick.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_closing, binary_fill_holes
from scipy.spatial import Delaunay, cKDTree

_ALPHA = 3.0  # circumradius limit in median point distances


def median_spacing(points: np.ndarray) -> float:
    """Median distance of a point to its nearest other point [m]; (M, 3) with M >= 2."""
    distance, _ = cKDTree(points).query(points, k=2)
    return float(np.median(distance[:, 1]))


def inside_volume_points(points: np.ndarray, query: np.ndarray) -> np.ndarray:
    """Which of ``query`` (Q, 3) lie inside the alpha shape of ``points`` (M, 3) that fill a body; (Q,) bool."""
    mesh = Delaunay(points)
    corners = points[mesh.simplices]
    edges = corners[:, 1:] - corners[:, :1]
    squares = np.sum(edges**2, axis=2)
    determinant = np.linalg.det(edges)
    flat = np.abs(determinant) < 1e-12 * np.maximum(squares.max(axis=1), 1e-30) ** 1.5
    safe = np.where(flat[:, None, None], np.eye(3), edges)
    radius = np.where(
        flat, np.inf, 0.5 * np.linalg.norm(np.linalg.solve(safe, squares[..., None])[..., 0], axis=1)
    )
    kept = radius <= _ALPHA * median_spacing(points) * 1.5
    found = mesh.find_simplex(query)
    gap, _ = cKDTree(points).query(query)
    return ((found >= 0) & kept[np.maximum(found, 0)]) | (gap <= 0.5 * median_spacing(points))


def inside_surface_points(points: np.ndarray, query: np.ndarray, cell: float) -> np.ndarray:
    """Which of ``query`` (Q, 3) lie inside the surface sampled by ``points`` (M, 3), at voxel size ``cell`` [m]."""
    cell = max(cell, 1.5 * median_spacing(points))
    low = points.min(axis=0) - 2 * cell
    shape = np.ceil((points.max(axis=0) + 2 * cell - low) / cell).astype(int) + 1
    shell = np.zeros(shape, dtype=bool)
    shell[tuple(((points - low) / cell).astype(int).T)] = True
    filled = binary_fill_holes(binary_closing(shell, iterations=1))
    index = ((query - low) / cell).astype(int)
    within = np.all((index >= 0) & (index < shape), axis=1)
    index = np.clip(index, 0, shape - 1)
    return within & filled[tuple(index.T)]
