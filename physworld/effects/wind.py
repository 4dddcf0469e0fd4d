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


_FASTEST_M_S = 20.0


@dataclass(frozen=True)
class Wind(Effect):
    """``push_x_m_s2`` …: p; ``rate_per_s``: c."""

    name = "wind"
    title = "wind"
    equation = "a = c (w - v) = p - c v"
    kind = "force"
    gates = ("push_x_m_s2", "push_y_m_s2", "push_z_m_s2", "rate_per_s")
    contains = ("air_drag_linear",)
    instead = "repeat the recording in a closed box"

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

    def implausible(self) -> str | None:
        """A wind is a push with the drag that it comes with: a push over a drag that is a gale is no wind in a room.

        Without the drag the push is other gravity, which has its own name.
        """
        push = float(np.linalg.norm([self.push_x_m_s2, self.push_y_m_s2, self.push_z_m_s2]))
        speed = push / max(self.rate_per_s, 1e-9)
        return f"a wind of {speed:.3g} m/s is not believed" if speed > _FASTEST_M_S else None

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds to gravity and to the drag rate: no kernel."""
        push = np.array([self.push_x_m_s2, self.push_y_m_s2, self.push_z_m_s2])
        return replace(
            problem,
            gravity_m_s2=np.asarray(problem.gravity_m_s2) + push,
            drag_per_s=problem.drag_per_s + self.rate_per_s,
        )
