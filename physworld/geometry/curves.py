"""Where a rope or sheet is at the start: nodal positions and velocities from few noisy tracked points.

Positions minimise  |W x - p|^2 / sigma^2 + bending + (stretch error)^2 : linear in the first two, a few Gauss-Newton
steps for the third, so that the curve between markers has the material's length. Velocities are fitted to a local
polynomial in time of the first frames, with the same smoothing.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.errors import SceneUnsupported
from physworld.geometry.shown import cloud_of_start, reach_along, spacing_of
from physworld.scene import Scene

_VELOCITY_WINDOW_S = 0.06  # frames within this time of the first give the start's velocity
_MIN_WINDOW_FRAMES = 4
_BENDING_WEIGHT = (
    1e-3  # against data in units of the cell: fills gaps between markers, bends markers by little
)
_STRETCH_WEIGHT = 0.3
_GAUSS_NEWTON_STEPS = 12
_BESIDE = 3.0  # median distances from a rod's axis: what of its cloud lies farther is none of it
_LONGER = 1.02  # times the extent of a straight rod's points: a declared length beyond it reaches past them


def fit_nodes(scene: Scene, lattice: Lattice, material: Array) -> tuple[Array, Array]:
    """Nodal positions [m] and velocities [m/s] at the first frame, both (n, 3).

    Args:
        scene: its first frames' visible points and controllers are used.
        lattice: of dimension 1 or 2.
        material: material coordinates of the tracked points [m], (N, d).

    Raises:
        SceneUnsupported: fewer points are visible than span a line (rod) or a plane (sheet).
    """
    seen = scene.visible[0]
    if seen.sum() < lattice.dim + 1:
        raise SceneUnsupported(
            f"{int(seen.sum())} of {len(seen)} points are visible in the first frame: too few to place a {scene.kind}"
        )
    weights = lattice.interpolation(material[seen])
    bending = _bending(lattice)
    spacing = float(lattice.spacing.min())
    data = weights / spacing
    normal = data.T @ data + _BENDING_WEIGHT * bending
    x = spsolve(normal.tocsc(), data.T @ (scene.points[0][seen] / spacing))
    slopes = _slopes(lattice)
    for _ in range(_GAUSS_NEWTON_STEPS):
        x = _unstretch(x, data, scene.points[0][seen] / spacing, bending, slopes)
    return x, _start_velocity(scene, lattice, material, bending)


def straight_extent(
    scene: Scene, along: Array, centre: Array, direction: Array, notes: list[str]
) -> tuple[float, float]:
    """Where a straight rod begins along ``direction`` from ``centre``, and its length [m].

    A cloud of the first frame shows its free end (:mod:`physworld.geometry.shown`). Without one its points (at
    ``along``) show it whole, unless a longer one is declared: then it reaches back to where it is held, and the rest of
    it past its last point; one that nobody holds reaches as far past its first.

    Args:
        scene: its declared length and its controllers are used.
        along: coordinates of the tracked points along ``direction`` [m], (N,).
        centre, direction: of the rod's axis, (3,) [m] and (3,) of unit length.
        notes: takes a sentence where the rod reaches past its points.
    """
    begin, length = float(along.min()), float(np.ptp(along))
    declared, cloud = scene.body.length_m, cloud_of_start(scene)
    if cloud is not None:
        off = cloud - centre
        beside = np.linalg.norm(off - np.outer(off @ direction, direction), axis=1)
        near = beside < _BESIDE * np.median(beside)
        reach = reach_along(
            off[near] @ direction, declared, (scene.controllers[0] - centre) @ direction, spacing_of(cloud)
        )
        if reach is not None:
            notes.append(f"the cloud of the first frame shows its ends: {reach[1]:.4g} m long")
            return reach
    if declared is None or scene.rest_volume_points is not None or declared <= _LONGER * length:
        return begin, length
    missing, held = declared - length, (scene.controllers[0] - centre) @ direction
    lead = 0.5 * missing
    if np.any(held < 0.0):
        lead = float(np.clip(begin - held[held < 0.0].mean(), 0.0, missing))
    notes.append(
        f"declared {declared:.4g} m long: it reaches {lead:.3g} m past its first and {missing - lead:.3g} m past its "
        "last tracked point"
    )
    return begin - lead, float(declared)


def _start_velocity(scene: Scene, lattice: Lattice, material: Array, bending: sparse.csr_matrix) -> Array:
    frames = max(_MIN_WINDOW_FRAMES, int(np.searchsorted(scene.times, _VELOCITY_WINDOW_S)) + 1)
    frames = min(frames, scene.train[1])
    if frames < 3:
        return np.zeros((len(lattice.nodes), 3))
    seen = scene.visible[:frames].all(axis=0)
    if not seen.any():
        return np.zeros((len(lattice.nodes), 3))
    design = np.stack([np.ones(frames), scene.times[:frames], scene.times[:frames] ** 2], axis=1)
    track = scene.points[:frames, seen].reshape(frames, -1)
    coefficients, *_ = np.linalg.lstsq(design, track, rcond=None)
    velocity = coefficients[1].reshape(-1, 3)
    data = lattice.interpolation(material[seen]) / float(lattice.spacing.min())
    normal = data.T @ data + _BENDING_WEIGHT * bending
    nodal: Array = spsolve(normal.tocsc(), data.T @ (velocity / float(lattice.spacing.min())))
    return nodal


def _bending(lattice: Lattice) -> sparse.csr_matrix:
    """Sum over particles of the squared second derivatives, in units of the cell: (n, n), with a tiny mass term."""
    coordinates = lattice.particle_coordinates
    total = 1e-9 * sparse.eye(len(lattice.nodes), format="csr")
    axes = range(lattice.dim)
    for orders in {tuple(int(a == i) + int(a == j) for a in axes) for i in axes for j in axes}:
        matrix = lattice.interpolation(coordinates, orders) * float(lattice.spacing.min())
        total = total + matrix.T @ matrix
    return total


def _slopes(lattice: Lattice) -> list[sparse.csr_matrix]:
    coordinates = lattice.particle_coordinates
    return [
        lattice.interpolation(coordinates, tuple(int(a == j) for a in range(lattice.dim)))
        for j in range(lattice.dim)
    ]


def _unstretch(
    x: Array,
    data: sparse.csr_matrix,
    target: Array,
    bending: sparse.csr_matrix,
    slopes: list[sparse.csr_matrix],
) -> Array:
    """One Gauss-Newton step on data, bending and (|x_,j| - 1)."""
    n = len(x)
    rows, residuals = [], []
    for slope in slopes:
        tangent = slope @ x
        length = np.maximum(np.linalg.norm(tangent, axis=1), 1e-9)
        direction = tangent / length[:, None]
        rows.append(sparse.hstack([sparse.diags(direction[:, i]) @ slope for i in range(3)]))
        residuals.append(length - 1.0)
    stretch, error = sparse.vstack(rows).tocsr(), np.concatenate(residuals)
    smooth = sparse.block_diag([data.T @ data + _BENDING_WEIGHT * bending] * 3)
    gradient = np.concatenate(
        [data.T @ (data @ x[:, i] - target[:, i]) + _BENDING_WEIGHT * (bending @ x[:, i]) for i in range(3)]
    )
    normal = smooth + _STRETCH_WEIGHT * stretch.T @ stretch
    step = spsolve(normal.tocsc(), -(gradient + _STRETCH_WEIGHT * stretch.T @ error))
    moved: Array = x + step.reshape(3, n).T
    return moved
