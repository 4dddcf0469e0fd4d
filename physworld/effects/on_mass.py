"""Terms that act on every piece of material by its mass: on the nodes of a lattice or rod, or on particles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from physworld.engine.problem import Problem
from physworld.engine.terms.term import BoundTerm
from physworld.engine.updated.terms import ParticleBody


@dataclass(frozen=True)
class OnMass:
    """A term whose device arrays are the masses alone; a law overrides :meth:`bound`."""

    def bind(self, problem: Problem) -> BoundTerm:
        """Device arrays."""
        return self.bound(wp.array(problem.nodal_mass(), dtype=wp.float64, device=problem.device))

    def on_particles(self, body: ParticleBody) -> BoundTerm:
        """Device arrays for particles in the place of nodes."""
        return self.bound(wp.array(body.mass, dtype=wp.float64, device=body.problem.device))

    def bound(self, mass: Any) -> BoundTerm:
        """The term on these masses, (n,) float64 [kg] on the device."""
        raise NotImplementedError(f"{type(self).__name__} says nothing of masses")
