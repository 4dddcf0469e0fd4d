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

_MEMORY = {3: 72, 2: 24, 1: 12}  # numbers a cell that friction remembers from the last substep


class InternalForces:
    """Forces of a body of dimension 1, 2 or 3.

    Args:
        lattice: the reference body.
        law: its constitutive parameters; must fit the lattice's dimension.
        stiffness_factor: factor on every stiffness and on the friction, a particle, (P,).
        rest: nodal positions of the undeformed body in the world [m], (n, 3); used by solids.
        device: Warp device.

    Raises:
        ValueError: the law is of another dimension.
    """

    def __init__(
        self, lattice: Lattice, law: Law, stiffness_factor: np.ndarray, rest: np.ndarray, device: str
    ) -> None:
        self.device = device
        self.cells = len(lattice.cells)
        self._model = model_inputs(lattice, law, stiffness_factor, rest, device)
        if isinstance(law, SolidLaw):
            self._kernel = solid_forces(law.stress, len(law.moduli))
        else:
            self._kernel = sheet_forces if isinstance(law, SheetLaw) else rod_forces
        self._solid = lattice.dim == 3
        self.memory = wp.zeros(
            self.cells * _MEMORY[lattice.dim], dtype=wp.float32 if self._solid else wp.float64, device=device
        )
        self.inverted = wp.zeros(1, dtype=wp.int32, device=device)

    def launch(self, x: wp.array, clock: wp.array, force: wp.array) -> None:
        """Add the forces [N] at nodal positions ``x`` (3n,) to ``force`` (3n,); ``clock[1]`` is 1/dt [1/s]."""
        wp.launch(
            self._kernel,
            dim=self.cells,
            inputs=[*self._model, clock, x, self.memory],
            outputs=[force, self.inverted] if self._solid else [force],
            device=self.device,
        )


def model_inputs(
    lattice: Lattice, law: Law, stiffness_factor: np.ndarray, rest: np.ndarray, device: str
) -> list[Any]:
    """What the kernels of a dimension take as their model: arrays on the device, then whether there is friction.

    Raises:
        ValueError: the law is of another dimension.
    """
    if not isinstance(law, {1: RodLaw, 2: SheetLaw, 3: SolidLaw}[lattice.dim]):
        raise ValueError(f"a {type(law).__name__} does not fit a lattice of dimension {lattice.dim}")

    def array(values: Any, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(values).reshape(-1), dtype=dtype, device=device)

    measure = lattice.particle_measures * stiffness_factor
    nodes = array(lattice.cell_nodes, wp.int32)
    if isinstance(law, SolidLaw):
        slopes = np.stack([lattice.table(tuple(int(a == j) for a in range(3))) for j in range(3)], axis=1)
        moduli = measure.reshape(len(lattice.cells), 1, -1) * np.array(law.moduli)[:, None]
        return [
            nodes, array(slopes, wp.float32), array(rest, wp.float64), array(moduli, wp.float32),
            array(law.viscosity_pa_s * measure, wp.float32), array([*law.numbers, 0.0], wp.float32),
            wp.vec3f(*(1.0 / lattice.spacing)), int(law.viscosity_pa_s > 0),
        ]  # fmt: skip
    friction = [wp.float64(law.relaxation_s), int(law.relaxation_s > 0)]
    if isinstance(law, SheetLaw):
        orders = [(1, 0), (0, 1), (2, 0), (0, 2), (1, 1)]
        derivatives = [lattice.table(o) / np.prod(lattice.spacing ** np.array(o)) for o in orders]
        return [
            nodes, array(np.stack(derivatives, axis=1), wp.float64), array(law.membrane_n_m * measure, wp.float64),
            array(law.bending_n_m * measure, wp.float64),
            array([*law.membrane_shape, *law.bending_shape], wp.float64), *friction,
        ]  # fmt: skip
    derivatives = [lattice.table((o,)) / lattice.spacing[0] ** o for o in (1, 2)]
    return [
        nodes, array(np.stack(derivatives, axis=1), wp.float64), array(law.stretching_n * measure, wp.float64),
        array(law.bending_n_m2 * measure, wp.float64), *friction,
    ]  # fmt: skip
