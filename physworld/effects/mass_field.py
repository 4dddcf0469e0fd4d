"""A density that varies over the body: low-rank, a slope along every material axis and one bump.

    log factor = sum_a s_a xi_a + b exp(-|xi - xi_0|^2 / (2 w^2))        xi in -1 … 1 over the body

The same field as ``stiffness_field``, on the density. The slopes keep the total mass to first order; a bump adds to it
(a weight that hangs from the tip, a marker that is heavy).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from physworld.effects.base import Strength
from physworld.effects.stiffness_field import LowRankField, field_strengths, log_field
from physworld.engine.problem import Problem

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class MassField(LowRankField):
    """A :class:`LowRankField` of the density."""

    name = "mass_field"
    title = "density that varies over the body"
    instead = "weigh the body's halves"

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Slopes up to e^1.5 either way; a bump may be ten times as heavy as the body there."""
        return tuple(
            replace(s, high=3.0) if s.name == "bump" else s for s in field_strengths(twin.lattice.dim)
        )

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Multiplies the density factor."""
        factor = np.exp(log_field(problem.lattice, self))
        known = 1.0 if problem.density_factor is None else problem.density_factor
        return replace(problem, density_factor=known * factor)
