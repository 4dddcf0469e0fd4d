"""A body under homogeneous deformation: its mean stress comes from its nodal forces, P = -(1/V) sum f_a (x) X_a."""

from __future__ import annotations

import numpy as np
import warp as wp
from bodies import rest_nodes

from physworld.devices import default_device
from physworld.engine.lattice.lattice import box_lattice
from physworld.engine.total.forces import InternalForces
from physworld.materials.solid import SolidLaw

LATTICE = box_lattice(np.zeros(3), np.array([0.12, 0.05, 0.04]), (3, 2, 1))
REST = rest_nodes(LATTICE)
VOLUME = float(LATTICE.particle_measures.sum())


def nodal_forces(
    law: SolidLaw, x: np.ndarray, clock: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """Internal forces [N] of the body at nodal positions (n, 3)."""
    forces = InternalForces(LATTICE, law, np.ones(LATTICE.fill.size), REST, default_device())
    out = wp.zeros(x.size, dtype=wp.float64)
    forces.launch(wp.array(x.reshape(-1), dtype=wp.float64), wp.array(clock, dtype=wp.float64), out)
    return out.numpy().reshape(-1, 3)


def mean_stress(law: SolidLaw, F: np.ndarray) -> np.ndarray:
    """First Piola-Kirchhoff stress [Pa] of the native kernel at deformation gradient F, (3, 3)."""
    force = nodal_forces(law, REST @ F.T + np.array([0.3, -0.2, 0.1]))
    return -force.T @ REST / VOLUME


def inverts(law: SolidLaw, F: np.ndarray) -> bool:
    """Whether the kernel reports an inversion at F."""
    forces = InternalForces(LATTICE, law, np.ones(LATTICE.fill.size), REST, default_device())
    out = wp.zeros(REST.size, dtype=wp.float64)
    x = wp.array((REST @ F.T).reshape(-1), dtype=wp.float64)
    forces.launch(x, wp.zeros(3, dtype=wp.float64), out)
    assert np.isfinite(out.numpy()).all()
    return bool(forces.inverted.numpy()[0])
