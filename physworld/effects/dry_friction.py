"""Dry friction with the surroundings: a = -d v / sqrt(|v|^2 + v0^2) on every piece of material, d in m/s^2.

Coulomb's law against something that stands still, as large at every speed: a table, a film or a brush that the scene
does not declare and that bears the same load everywhere; d = mu g for a body that lies flat. Below v0 = 20 mm/s it is
viscous, so that a body comes to rest without chattering. A body decelerates at an even rate where linear drag lets it
die away. A body in the air rubs against nothing: beside drag and viscosity it needs fifty times their support.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import warp as wp

from physworld.effects.base import Effect, Strength
from physworld.effects.on_mass import OnMass
from physworld.effects.places import gravity_size
from physworld.engine.problem import Problem
from physworld.engine.terms.term import BoundTerm

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

SLOW_M_S = 0.02


@wp.kernel
def dry_friction(
    # model
    mass: wp.array[wp.float64],
    size: wp.float64,
    slow: wp.float64,
    # in
    v: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Add -m d v / sqrt(|v|^2 + v0^2) at one node."""
    node = wp.tid()
    velocity = wp.vec3d(v[3 * node], v[3 * node + 1], v[3 * node + 2])
    pull = -mass[node] * size / wp.sqrt(wp.dot(velocity, velocity) + slow * slow)
    for i in range(3):
        force[3 * node + i] += pull * velocity[i]


@dataclass(frozen=True)
class DryFrictionTerm(OnMass):
    """Term of :class:`DryFriction`."""

    size_m_s2: float

    def bound(self, mass: Any) -> BoundDryFriction:
        """See :meth:`OnMass.bound`."""
        return BoundDryFriction(mass, self.size_m_s2, self.size_m_s2 / SLOW_M_S)


@dataclass(frozen=True)
class BoundDryFriction(BoundTerm):
    """Masses of nodes or particles on the device."""

    mass: wp.array
    size_m_s2: float
    friction_per_s: float

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the friction [N]."""
        inputs = [self.mass, wp.float64(self.size_m_s2), wp.float64(SLOW_M_S), v]
        wp.launch(dry_friction, dim=len(self.mass), inputs=inputs, outputs=[force], device=self.mass.device)


@dataclass(frozen=True)
class DryFriction(Effect):
    """``size_m_s2``: d [m/s^2]."""

    name = "dry_friction"
    title = "dry friction with the surroundings"
    equation = "a = -d v / sqrt(|v|^2 + v0^2)"
    kind = "force"
    gates = ("size_m_s2",)
    odds = 0.02

    size_m_s2: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """One size, up to a coefficient of friction of one."""
        weight = gravity_size(twin)
        return (Strength("size_m_s2", "m/s^2", 0.0, weight, 0.005 * weight),)

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the term."""
        return replace(problem, terms=(*problem.terms, DryFrictionTerm(self.size_m_s2)))
