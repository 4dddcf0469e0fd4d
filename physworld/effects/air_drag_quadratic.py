"""Quadratic air drag: a = -k |v| v on every piece of material, k in 1/m.

Drag by mass at high Reynolds number: k = C_d rho_air A / (2 m) for the body's area over its mass. Amplitude tells it
from the linear law, so the two need a recording that is fast and slow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import warp as wp

from physworld.effects.base import Effect, Strength
from physworld.effects.on_mass import OnMass
from physworld.engine.problem import Problem
from physworld.engine.terms.term import BoundTerm

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@wp.kernel
def quadratic_drag(
    # model
    mass: wp.array[wp.float64],
    coefficient: wp.float64,
    # in
    v: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Add -m k |v| v at one node."""
    node = wp.tid()
    velocity = wp.vec3d(v[3 * node], v[3 * node + 1], v[3 * node + 2])
    pull = -mass[node] * coefficient * wp.length(velocity)
    for i in range(3):
        force[3 * node + i] += pull * velocity[i]


@dataclass(frozen=True)
class QuadraticDrag(OnMass):
    """Term of :class:`AirDragQuadratic`."""

    coefficient_per_m: float

    def bound(self, mass: Any) -> BoundQuadraticDrag:
        """See :meth:`OnMass.bound`."""
        return BoundQuadraticDrag(mass, self.coefficient_per_m)


@dataclass(frozen=True)
class BoundQuadraticDrag(BoundTerm):
    """Masses of nodes or particles on the device. k |v| is far below the rates that limit a time step."""

    mass: wp.array
    coefficient_per_m: float

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the drag [N]."""
        inputs = [self.mass, wp.float64(self.coefficient_per_m), v]
        wp.launch(quadratic_drag, dim=len(self.mass), inputs=inputs, outputs=[force], device=self.mass.device)


@dataclass(frozen=True)
class AirDragQuadratic(Effect):
    """``coefficient_per_m``: k [1/m]."""

    name = "air_drag_quadratic"
    title = "quadratic air drag"
    equation = "a = -k |v| v"
    kind = "force"
    gates = ("coefficient_per_m",)

    coefficient_per_m: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """One coefficient; at 10 1/m a fall ends at 1 m/s."""
        return (Strength("coefficient_per_m", "1/m", 0.0, 10.0, 0.1),)

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the term."""
        return replace(problem, terms=(*problem.terms, QuadraticDrag(self.coefficient_per_m)))
