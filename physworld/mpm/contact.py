"""Contact of a solid with a horizontal ground: penalty pressure and regularised Coulomb friction on surface points.

Surface points sit on the exposed faces of the cells (2 x 2 a face). The pressure is (lambda + 2 mu) / dx times the
depth: one more cell of material a cell's depth, so a block at rest sinks by its own compression over one cell. The
friction is min(mu p, 0.3 rho c |v|) against the sliding velocity: below the Coulomb limit it is a viscous stick.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from physworld.materials.laws import SolidLaw
from physworld.mpm.bspline import GAUSS_POINTS
from physworld.mpm.lattice import Lattice
from physworld.mpm.node_kernels import ground_contact
from physworld.mpm.terms import BoundTerm

if TYPE_CHECKING:
    from physworld.mpm.total_lagrangian import Problem

_STICK_IMPEDANCE = 0.3  # share of rho c
_BOUNDARY_MASS = 6.0  # the outermost nodal layer of a quadratic spline carries 1/6 of a cell


@dataclass(frozen=True)
class GroundContact:
    """Ground at ``height_m`` with Coulomb ``friction`` under the surface points of ``lattice``."""

    lattice: Lattice
    law: SolidLaw
    height_m: float
    friction: float

    def bind(self, problem: Problem) -> BoundContact:
        """Device arrays for one problem."""
        device = problem.device
        points, areas = surface_points(self.lattice)
        matrix = self.lattice.interpolation(points)
        mu, lam = self.law.lame
        stiffness = (lam + 2 * mu) / float(self.lattice.spacing.min())
        impedance = _STICK_IMPEDANCE * self.law.density_kg_m3 * self.law.wave_speed_m_s
        return BoundContact(
            points=len(points),
            inputs=[
                wp.array(matrix.indptr, dtype=wp.int32, device=device),
                wp.array(matrix.indices, dtype=wp.int32, device=device),
                wp.array(matrix.data, dtype=wp.float64, device=device),
                wp.array(areas, dtype=wp.float64, device=device),
                wp.float64(self.height_m), wp.float64(self.friction), wp.float64(stiffness), wp.float64(impedance),
            ],
            device=device,
            frequency_rad_s=contact_frequency(self.law, self.lattice),
        )  # fmt: skip


@dataclass(frozen=True)
class BoundContact(BoundTerm):
    """A ground contact whose arrays live on a device."""

    points: int
    inputs: list
    device: str
    frequency_rad_s: float

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add contact forces [N] at nodal positions and velocities (3n,) to ``force``."""
        wp.launch(
            ground_contact, dim=self.points, inputs=[*self.inputs, x, v], outputs=[force], device=self.device
        )


def contact_frequency(law: SolidLaw, lattice: Lattice) -> float:
    """Angular frequency [rad/s] that the penalty adds to the outermost nodes."""
    return float(np.sqrt(_BOUNDARY_MASS) * law.wave_speed_m_s / lattice.spacing.min())


def surface_points(lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """Reference coordinates (S, 3) [m] and areas (S,) [m^2] of points on the exposed faces of a solid's cells."""
    present = {tuple(cell) for cell in lattice.cells}
    points, areas = [], []
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        area = float(np.prod(lattice.spacing[others])) / 4
        for side in (0, 1):
            step = np.zeros(3, dtype=int)
            step[axis] = 1 if side else -1
            exposed = np.array([c for c in lattice.cells if tuple(c + step) not in present]).reshape(-1, 3)
            for first in GAUSS_POINTS:
                for second in GAUSS_POINTS:
                    local = np.zeros(3)
                    local[axis], local[others[0]], local[others[1]] = side, first, second
                    points.append(lattice.origin + (exposed + local) * lattice.spacing)
                    areas.append(np.full(len(exposed), area))
    return np.concatenate(points), np.concatenate(areas)
