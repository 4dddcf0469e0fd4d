"""Internal friction of one lattice under one law, apart from its elastic forces; see the kernels' text."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.total.forces import model_inputs
from physworld.engine.total.friction_kernels import (
    prepare_solid_friction,
    rod_friction,
    sheet_friction,
    solid_friction,
)
from physworld.materials.laws import Law


class FrictionForces:
    """Forces -C(x) v [N] of a law's friction; arguments are those of
    :class:`physworld.engine.total.forces.InternalForces`.

    Raises:
        ValueError: the law is of another dimension.
    """

    def __init__(self, lattice: Lattice, law: Law, stiffness_factor: Array, rest: Array, device: str) -> None:
        model = model_inputs(lattice, law, stiffness_factor, rest, device)
        self.device, self._cells, self._dim = device, len(lattice.cells), lattice.dim
        self._at = wp.array(np.ascontiguousarray(rest).reshape(-1), dtype=wp.float64, device=device)
        if lattice.dim == 3:
            nodes, slopes, start, _, eta, _, inv_dx, _ = model
            self._turned = wp.zeros(72 * self._cells, dtype=wp.float32, device=device)
            self._place: list[Any] = [nodes, slopes, start, eta, inv_dx]
            self._kernel, self._model = solid_friction, [nodes, slopes, inv_dx, self._turned]
            self.prepare(self._at)
        elif lattice.dim == 2:
            self._kernel, self._model = sheet_friction, [*model[:-1], self._at]
        else:
            nodes, derivatives, _, bending, tau, _ = model
            self._kernel, self._model = rod_friction, [nodes, derivatives, bending, tau, self._at]

    def prepare(self, x: wp.array) -> None:
        """From now on the friction is that at nodal positions ``x`` [m], (3n,); before, at rest."""
        if self._dim < 3:
            wp.copy(self._at, x)
        else:
            wp.launch(
                prepare_solid_friction, dim=self._cells, inputs=[*self._place, x], outputs=[self._turned],
                device=self.device,
            )  # fmt: skip

    def launch(self, v: wp.array, force: wp.array) -> None:
        """Add the friction [N] at velocities ``v`` [m/s], (3n,), to ``force`` (3n,)."""
        inputs = [*self._model, v]
        wp.launch(self._kernel, dim=self._cells, inputs=inputs, outputs=[force], device=self.device)
