"""The internal forces differentiated: what reverse-mode gradients through the time stepping are built on.

With f(x, x_previous; p) the forces of one substep and w any nodal field (the adjoint of the forces), an
:class:`InternalTangent` adds the products d(w.f)/dx, d(w.f)/dx_previous and d(w.f)/d log p. Elastic forces are minus
the gradient of an energy, so their d(w.f)/dx is also the directional derivative df/dx w.

Friction takes the rate from the last substep, (x - x_previous) / dt, as the forces do. Everything is evaluated afresh
from positions: nothing is remembered between calls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import warp as wp

from physworld.arrays import Array
from physworld.engine.gradients.solid_tangent_kernels import solid_tangent
from physworld.engine.gradients.thin_tangent_kernels import rod_tangent, sheet_tangent
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.total.forces import model_inputs
from physworld.materials.laws import Law

_KERNELS: dict[int, Callable[[Any], wp.Kernel]] = {
    3: lambda law: solid_tangent(law.stress, len(law.moduli)),
    2: lambda law: sheet_tangent,
    1: lambda law: rod_tangent,
}


class InternalTangent:
    """Derivatives of the forces of :class:`physworld.engine.total.forces.InternalForces`, built from the same
    arguments.

    Attributes:
        parameters: names of the columns of ``parameter_out``: every modulus, then the friction. A column is the
            derivative to the logarithm of that number at the particle.
        stiffness_columns: the columns that add up to the derivative to the logarithm of the particle's stiffness
            factor (it scales the moduli, and a solid's friction; a thin body's friction is in its moduli's columns).
        particles: rows of ``parameter_out``.

    Args:
        lattice: of the body.
        law: of its material.
        stiffness_factor: of every particle (P,).
        rest: particles or nodes at rest, as the forces take them [m].
        device: of Warp.
    """

    def __init__(self, lattice: Lattice, law: Law, stiffness_factor: Array, rest: Array, device: str) -> None:
        self.device = device
        self.particles = lattice.fill.size
        self._cells = len(lattice.cells)
        *self._model, self._viscous = model_inputs(lattice, law, stiffness_factor, rest, device)
        self._kernel = _KERNELS[lattice.dim](law)
        self.parameters, self.stiffness_columns = tuple(law.columns), law.stiffness_columns
        self._still = wp.zeros(3, dtype=wp.float64, device=device)
        self._nothing = wp.zeros(1, dtype=wp.float64, device=device)

    def apply(self, x: wp.array, w: wp.array, out: wp.array, parameter_out: wp.array | None = None) -> None:
        """Add the elastic products; friction is silent, as it is where nothing moves.

        Args:
            x: nodal positions [m], (3n,) float64.
            w: the direction, (3n,) float64.
            out: df/dx w [N/m times w] is added, (3n,) float64.
            parameter_out: d(w.f)/d log p is added, (P * columns,) float64, particles first; None: not wanted.
        """
        self._launch(0, self._still, x, x, w, out, self._nothing, parameter_out)

    def apply_with_friction(
        self,
        x: wp.array,
        x_previous: wp.array,
        clock: wp.array,
        w: wp.array,
        out: wp.array,
        out_previous: wp.array,
        parameter_out: wp.array | None = None,
    ) -> None:
        """Add the products of the forces of one substep, friction included.

        Args:
            x, x_previous: nodal positions at which the forces act, and those of the substep before [m], (3n,).
            clock: ``clock[1]`` is 1/dt [1/s].
            w: the direction, (3n,).
            out, out_previous: d(w.f)/dx and d(w.f)/dx_previous are added, (3n,).
            parameter_out: as in :meth:`apply`.
        """
        self._launch(self._viscous, clock, x, x_previous, w, out, out_previous, parameter_out)

    def _launch(
        self,
        viscous: int,
        clock: wp.array,
        x: wp.array,
        x_previous: wp.array,
        w: wp.array,
        out: wp.array,
        out_previous: wp.array,
        parameter_out: wp.array | None,
    ) -> None:
        wanted = parameter_out is not None
        wp.launch(
            self._kernel,
            dim=self._cells,
            inputs=[*self._model, viscous, int(wanted), clock, x, x_previous, w],
            outputs=[out, out_previous, parameter_out if wanted else self._nothing],
            device=self.device,
        )
