"""Quadratic air drag across a rod, none along it: a = -b |v_n| v_n per mass, v_n the velocity across.

b = rho_air C d / (2 rho A) of a rod of diameter d and mass per length rho A, with C about 1.1 (a circular cylinder in
cross flow). A rod that slides along itself feels nothing; :mod:`physworld.effects.air_drag_quadratic` is alike in all
directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from physworld.effects.base import Effect, Strength
from physworld.engine.problem import Problem
from physworld.materials.cable import CableLaw

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class AirDragAcross(Effect):
    """``coefficient_per_m``: b [1/m]."""

    name = "air_drag_across"
    title = "quadratic air drag across a rod"
    equation = "a = -b |v_n| v_n"
    kind = "force"
    gates = ("coefficient_per_m",)

    coefficient_per_m: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """One coefficient; at 10 1/m a fall across ends at 1 m/s."""
        return (Strength("coefficient_per_m", "1/m", 0.0, 10.0, 0.1),)

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """Only discrete rods tell across from along."""
        return (
            None
            if isinstance(twin.law, CableLaw)
            else f"a {type(twin.law).__name__} has no drag across itself"
        )

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds to the law's drag."""
        law = problem.law
        assert isinstance(law, CableLaw)
        return replace(
            problem, law=replace(law, drag_normal_per_m=law.drag_normal_per_m + self.coefficient_per_m)
        )
