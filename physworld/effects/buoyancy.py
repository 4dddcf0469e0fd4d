"""A fluid around the body: it carries part of the weight and moves with the body.

    (1 + a) m dv/dt = f + (1 - b) m g        b = rho_fluid / rho_body, a = C_m b (C_m 0.5 for a ball, 1 for a cylinder)

b and a are separate strengths, since C_m depends on the shape and on the direction: b shows in the droop, a in the
frequency. Other effects by mass (drag, wind) act on the mass with the added one, and a load that hangs
from the body counts as the body.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from physworld.effects.base import Effect, Strength
from physworld.engine.problem import Problem

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class Buoyancy(Effect):
    """``density_ratio``: b, fluid over body; ``added_mass_ratio``: a, added mass over the body's."""

    name = "buoyancy"
    title = "buoyancy and added mass"
    equation = "(1 + a) m dv/dt = f + (1 - b) m g"
    kind = "force"
    gates = ("density_ratio", "added_mass_ratio")
    instead = "weigh the body in the same surroundings"

    density_ratio: float = 0.0
    added_mass_ratio: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """From air to a liquid twice as dense as the body."""
        return (
            Strength("density_ratio", "1", 0.0, 2.0, 0.01),
            Strength("added_mass_ratio", "1", 0.0, 3.0, 0.01),
        )

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Changes gravity and the density field."""
        factor = np.ones(twin.lattice.fill.size) if problem.density_factor is None else problem.density_factor
        load = problem.added_mass
        share = (1.0 - self.density_ratio) / (1.0 + self.added_mass_ratio)
        return replace(
            problem,
            gravity_m_s2=share * np.asarray(problem.gravity_m_s2),
            density_factor=(1.0 + self.added_mass_ratio) * factor,
            added_mass=None if load is None else (1.0 + self.added_mass_ratio) * load,
        )
