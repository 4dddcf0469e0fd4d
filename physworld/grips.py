"""Which nodes a grip holds: every node that the gripped material touches."""

from __future__ import annotations

import numpy as np

from physworld.geometry.reference import ReferenceBody
from physworld.scene import Grip


def gripped_nodes(body: ReferenceBody, controllers: np.ndarray, grip: Grip | None) -> np.ndarray:
    """Every node that gripped material touches: all nodes of cells most of whose material is in the grip."""
    lattice = body.lattice
    particles = lattice.interpolation(lattice.particle_coordinates) @ body.start
    slack, tie = 1e-6, 1e-9
    declared = grip is not None and grip.region_min_m is not None
    if declared and lattice.dim == 3 and np.any(grip.region_max_m <= grip.region_min_m):
        return _bonded_nodes(body, grip)
    if declared:
        low, high = np.asarray(grip.region_min_m) - slack, np.asarray(grip.region_max_m) + slack
        margin = 0.5 * body.thickness_m if lattice.dim < 3 else 0.0
        inside = np.all((particles >= low - margin) & (particles <= high + margin), axis=1)
    else:
        nearest = lattice.particle_coordinates[_nearest(particles, controllers)]
        reach = 0.5 * lattice.spacing
        low, high = nearest.min(axis=0) - reach, nearest.max(axis=0) + reach
        coordinates = lattice.particle_coordinates
        inside = np.all((coordinates >= low) & (coordinates <= high), axis=1)
    material = lattice.fill.sum(axis=1)
    share = (inside.reshape(lattice.fill.shape) * lattice.fill).sum(axis=1) / np.where(
        material > 0, material, 1.0
    )
    most = share > 0.5 + tie if declared else share >= 0.5 - tie
    cells = most if np.any(most) else share > 0
    if not np.any(cells):
        cells = np.zeros(len(lattice.cells), dtype=bool)
        cells[np.unique(_nearest(particles, controllers) // lattice.fill.shape[1])] = True
    return np.unique(lattice.cell_nodes[cells])


def _bonded_nodes(body: ReferenceBody, grip: Grip) -> np.ndarray:
    """The two layers of nodes whose splines fix an end face: of a grip without depth."""
    axis = int(np.argmin(grip.region_max_m - grip.region_min_m))
    lattice = body.lattice
    distance = np.abs(lattice.node_coordinates[:, axis] - grip.region_min_m[axis]) / lattice.spacing[axis]
    return np.flatnonzero(distance < 1.0)


def _nearest(particles: np.ndarray, targets: np.ndarray) -> np.ndarray:
    return np.argmin(np.linalg.norm(targets[:, None] - particles[None], axis=2), axis=1)
