"""Linear air drag: a = -c v on every piece of material, c in 1/s.

Drag by mass: what a fluid of low Reynolds number does to a body of even thickness. It acts on rigid motion too, which
internal viscosity does not. It adds to the twin's own ``air_drag_per_s`` and costs no kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from physworld.effects.base import Effect, Strength
from physworld.engine.problem import Problem

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class AirDragLinear(Effect):
    """``rate_per_s``: c [1/s]."""

    name = "air_drag_linear"
    title = "linear air drag"
    equation = "a = -c v"
    kind = "force"
    gates = ("rate_per_s",)

    rate_per_s: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """One rate; 30 1/s stops a fall at 0.3 m/s."""
        return (Strength("rate_per_s", "1/s", 0.0, 30.0, 0.1),)

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds to the drag rate of the nodes."""
        return replace(problem, drag_per_s=problem.drag_per_s + self.rate_per_s)
