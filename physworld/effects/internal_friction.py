"""Dry friction inside a rod: a bending moment that opposes the change of curvature, whatever its rate (Dahl 1968).

    M += B k_f z        k_o z' = k' - |k'| z

z, between -1 and 1, follows the curvature k until it has changed by about k_o, and then slips: strands, sheath and
cells rub on each other. Energy is lost by the cycle and not by the rate, so that slow motions damp as much as fast ones
and a rod does not come back to where it was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from physworld.effects.base import Effect, Strength
from physworld.effects.places import body_size
from physworld.engine.problem import Problem
from physworld.materials.cable import CableLaw

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class InternalFriction(Effect):
    """``moment_per_m``: k_f, the moment over the bending stiffness B; ``onset_per_m``: k_o."""

    name = "internal_friction"
    title = "dry friction inside a rod"
    equation = "M += B k_f z, k_o z' = k' - |k'| z"
    kind = "stress"
    gates = ("moment_per_m",)

    moment_per_m: float = 0.0
    onset_per_m: float = 1.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to the moment that a rod's own length of curvature has ten times; the onset is a shape of it."""
        scale = 1.0 / body_size(twin)
        return (
            Strength("moment_per_m", "1/m", 0.0, 10.0 * scale, 0.05 * scale),
            Strength("onset_per_m", "1/m", 0.05 * scale, 20.0 * scale, 0.1 * scale, gate=False, start=scale),
        )

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """Only discrete rods hold such a moment."""
        return (
            None if isinstance(twin.law, CableLaw) else f"a {type(twin.law).__name__} has no friction moment"
        )

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds to the law's friction."""
        law = problem.law
        assert isinstance(law, CableLaw)
        moment = law.friction_per_m + self.moment_per_m
        return replace(
            problem, law=replace(law, friction_per_m=moment, friction_onset_per_m=self.onset_per_m)
        )
