"""Internal forces of one lattice under one law: what a formulation launches every substep.

An :class:`InternalForces` owns the device arrays of the law (stiffness times measure at every particle, tables of
spline derivatives) and launches the kernel of its dimension. It knows nothing of time steps, grips or gravity.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from physworld.materials.laws import Law, RodLaw, SheetLaw, SolidLaw
from physworld.mpm.lattice import Lattice
from physworld.mpm.rod_kernels import rod_forces
from physworld.mpm.sheet_kernels import sheet_forces
from physworld.mpm.solid_kernels import solid_forces


class InternalForces:
    """Forces of a body of dimension 1, 2 or 3.

    Args:
        lattice: the reference body.
        law: its constitutive parameters; must fit the lattice's dimension.
        stiffness_factor: factor on every stiffness and on the friction, a particle, (P,).
        rest: nodal positions of the undeformed body in the world [m], (n, 3); used by solids.
        device: Warp device.
    """

    def __init__(
        self, lattice: Lattice, law: Law, stiffness_factor: np.ndarray, rest: np.ndarray, device: str
    ) -> None:
        if not isinstance(law, {1: RodLaw, 2: SheetLaw, 3: SolidLaw}[lattice.dim]):
            raise ValueError(f"a {type(law).__name__} does not fit a lattice of dimension {lattice.dim}")
        self.device = device
        self.cells = len(lattice.cells)
        measure = lattice.particle_measures * stiffness_factor
        self._nodes = wp.array(lattice.cell_nodes.reshape(-1), dtype=wp.int32, device=device)
        self._solid_body = isinstance(law, SolidLaw)
        if isinstance(law, SolidLaw):
            self._kernel = solid_forces(law.stress, len(law.moduli))
            self._model, self._state = self._solid(lattice, law, measure, rest)
        elif isinstance(law, SheetLaw):
            self._kernel, self._model, self._state = sheet_forces, *self._sheet(lattice, law, measure)
        else:
            self._kernel, self._model, self._state = rod_forces, *self._rod(lattice, law, measure)
        self.inverted = wp.zeros(1, dtype=wp.int32, device=device)

    def launch(self, x: wp.array, clock: wp.array, force: wp.array) -> None:
        """Add the forces [N] at nodal positions ``x`` (3n,) to ``force`` (3n,); ``clock[1]`` is 1/dt [1/s]."""
        outputs = [force, self.inverted] if self._solid_body else [force]
        wp.launch(
            self._kernel,
            dim=self.cells,
            inputs=[self._nodes, *self._model, clock, x, self._state],
            outputs=outputs,
            device=self.device,
        )

    def _array(self, values: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(values).reshape(-1), dtype=dtype, device=self.device)

    def _solid(
        self, lattice: Lattice, law: SolidLaw, measure: np.ndarray, rest: np.ndarray
    ) -> tuple[list, wp.array]:
        slopes = np.stack([lattice.table(tuple(int(a == j) for a in range(3))) for j in range(3)], axis=1)
        model = [
            self._array(slopes, wp.float32),
            self._array(rest, wp.float64),
            self._array(measure.reshape(self.cells, 1, 8) * np.array(law.moduli)[:, None], wp.float32),
            self._array(law.viscosity_pa_s * measure, wp.float32),
            self._array(np.array([*law.numbers, 0.0]), wp.float32),
            wp.vec3f(*(1.0 / lattice.spacing)),
            int(law.viscosity_pa_s > 0),
        ]
        return model, wp.zeros(self.cells * 72, dtype=wp.float32, device=self.device)

    def _sheet(self, lattice: Lattice, law: SheetLaw, measure: np.ndarray) -> tuple[list, wp.array]:
        orders = [(1, 0), (0, 1), (2, 0), (0, 2), (1, 1)]
        derivatives = np.stack(
            [lattice.table(o) / np.prod(lattice.spacing ** np.array(o)) for o in orders], axis=1
        )
        model = [
            self._array(derivatives, wp.float64),
            self._array(law.membrane_n_m * measure, wp.float64),
            self._array(law.bending_n_m * measure, wp.float64),
            self._array(np.array([*law.membrane_shape, *law.bending_shape]), wp.float64),
            wp.float64(law.relaxation_s),
            int(law.relaxation_s > 0),
        ]
        return model, wp.zeros(self.cells * 24, dtype=wp.float64, device=self.device)

    def _rod(self, lattice: Lattice, law: RodLaw, measure: np.ndarray) -> tuple[list, wp.array]:
        derivatives = np.stack([lattice.table((o,)) / lattice.spacing[0] ** o for o in (1, 2)], axis=1)
        model = [
            self._array(derivatives, wp.float64),
            self._array(law.stretching_n * measure, wp.float64),
            self._array(law.bending_n_m2 * measure, wp.float64),
            wp.float64(law.relaxation_s),
            int(law.relaxation_s > 0),
        ]
        return model, wp.zeros(self.cells * 12, dtype=wp.float64, device=self.device)
