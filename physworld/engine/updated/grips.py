"""Grips in the updated Lagrangian form: which particles are gripped, and their rigid paths.

A grip of the problem prescribes nodes of the reference lattice. A cell all of whose nodes are prescribed is gripped
material; its particles follow those nodes, and carry their velocity and its gradient to the grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.errors import SceneUnsupported

_AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


@dataclass(frozen=True)
class ParticleGrips:
    """Gripped particles: numbers (G,), and at the frames positions and velocities (T, G, 3), gradients (T, G, 3, 3)."""

    particles: Array
    positions: Array
    velocities: Array
    gradients: Array

    def upload(self, device: str) -> list[wp.array]:
        """(numbers, positions, velocities, gradients) on the device."""
        return [
            wp.array(self.particles.astype(np.int32), dtype=wp.int32, device=device),
            wp.array(np.ascontiguousarray(self.positions), dtype=wp.vec3d, device=device),
            wp.array(np.ascontiguousarray(self.velocities), dtype=wp.vec3d, device=device),
            wp.array(np.ascontiguousarray(self.gradients, dtype=np.float32), dtype=wp.mat33f, device=device),
        ]


def particle_grips(
    lattice: Lattice, solid: Array, nodes: Array, positions: Array, velocities: Array
) -> ParticleGrips:
    """Gripped particles of held nodes.

    Args:
        lattice: the reference body.
        solid: numbers of the particles that exist, (P,): those of the lattice with material.
        nodes: held nodes, (H,).
        positions, velocities: their paths, (T, H, 3).

    Raises:
        SceneUnsupported: nodes are held, but no whole cell is.
    """
    held = np.asarray(np.isin(lattice.cell_nodes, nodes).all(axis=1))
    if len(nodes) and not held.any():
        raise SceneUnsupported(
            f"{len(nodes)} nodes are held but none of {len(lattice.cells)} cells has all its nodes held: "
            "the updated Lagrangian form grips material, not single nodes"
        )
    per_cell = lattice.fill.shape[1]
    gripped = np.flatnonzero(held[solid // per_cell])
    if not len(gripped):
        empty = np.zeros((len(positions), 0, 3))
        return ParticleGrips(gripped, empty, empty, np.zeros((len(positions), 0, 3, 3)))
    coordinates = lattice.particle_coordinates[solid[gripped]]
    value = lattice.interpolation(coordinates)[:, nodes]
    slopes = [lattice.interpolation(coordinates, axis)[:, nodes] for axis in _AXES]

    def carry(matrix: Any, paths: Array) -> Array:
        flat = matrix @ paths.transpose(1, 0, 2).reshape(paths.shape[1], -1)
        return np.asarray(flat).reshape(len(gripped), len(paths), 3).transpose(1, 0, 2)

    shape = np.stack([carry(slope, positions) for slope in slopes], axis=-1)
    rate = np.stack([carry(slope, velocities) for slope in slopes], axis=-1)
    return ParticleGrips(
        gripped, carry(value, positions), carry(value, velocities), rate @ np.linalg.inv(shape)
    )
