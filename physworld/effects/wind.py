"""Wind: linear drag against air that moves with the velocity w.

    a = c (w - v) = p - c v        p = c w

Only p = c w [m/s^2] and c [1/s] are identifiable: in a breeze that the body is too slow to notice (c small) the wind
is a constant push whatever its speed. So p and c are the strengths, both linear, and w = p / c is derived. The push
alone is the same as other gravity (``gravity_tilt``); the drag alone is ``air_drag_linear``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from physworld.effects.base import Effect, Strength
from physworld.effects.places import gravity_size
from physworld.engine.problem import Problem

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class Wind(Effect):
    """``push_x_m_s2`` …: p; ``rate_per_s``: c."""

    name = "wind"
    title = "wind"
    equation = "a = c (w - v) = p - c v"
    kind = "force"
    gates = ("push_x_m_s2", "push_y_m_s2", "push_z_m_s2", "rate_per_s")

    push_x_m_s2: float = 0.0
    push_y_m_s2: float = 0.0
    push_z_m_s2: float = 0.0
    rate_per_s: float = 0.0

    def derived(self, twin: Twin) -> dict[str, tuple[float, str]]:
        """The wind's velocity, where there is a drag to give it."""
        if self.rate_per_s == 0:
            return {}
        push = {"x": self.push_x_m_s2, "y": self.push_y_m_s2, "z": self.push_z_m_s2}
        return {f"wind_{axis}_m_s": (value / self.rate_per_s, "m/s") for axis, value in push.items()}

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Pushes up to the body's weight."""
        weight = gravity_size(twin)
        pushes = (
            Strength(f"push_{axis}_m_s2", "m/s^2", -weight, weight, 0.01 * weight) for axis in ("x", "y", "z")
        )
        return (*pushes, Strength("rate_per_s", "1/s", 0.0, 30.0, 0.1))

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds to gravity and to the drag rate: no kernel."""
        push = np.array([self.push_x_m_s2, self.push_y_m_s2, self.push_z_m_s2])
        return replace(
            problem,
            gravity_m_s2=np.asarray(problem.gravity_m_s2) + push,
            drag_per_s=problem.drag_per_s + self.rate_per_s,
        )
