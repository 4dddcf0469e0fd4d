"""Gravity that is not as declared: turned by two small angles, and stronger or weaker by a share.

    g' = (1 + s) R(a e1 + b e2) g        e1, e2 horizontal: for gravity along -z they are x and y

R is the rotation by the vector a e1 + b e2 [rad]. A tilted world frame (a camera or a table out of level) looks the
same. Constant in time, which drag and lag are not. On a body whose stiffness is free the magnitude confounds with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.effects.base import Effect, Strength
from physworld.engine.problem import Problem

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class GravityTilt(Effect):
    """``tilt_x_rad``, ``tilt_y_rad``: a and b; ``magnitude``: s."""

    name = "gravity_tilt"
    title = "tilted gravity"
    equation = "g' = (1 + s) R(a e1 + b e2) g"
    kind = "force"
    gates = ("tilt_x_rad", "tilt_y_rad", "magnitude")

    tilt_x_rad: float = 0.0
    tilt_y_rad: float = 0.0
    magnitude: float = 0.0

    def derived(self, twin: Twin) -> dict[str, tuple[float, str]]:
        """The whole angle."""
        return {"tilt_deg": (float(np.degrees(np.hypot(self.tilt_x_rad, self.tilt_y_rad))), "deg")}

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to half a radian either way, half as much or half more."""
        return (
            Strength("tilt_x_rad", "rad", -0.5, 0.5, 0.01),
            Strength("tilt_y_rad", "rad", -0.5, 0.5, 0.01),
            Strength("magnitude", "1", -0.5, 0.5, 0.01),
        )

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """Without gravity there is nothing to tilt."""
        size = float(np.linalg.norm(twin.gravity_m_s2))
        return f"gravity is {size:.3g} m/s^2: nothing to tilt" if size < 1e-6 else None

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Replaces the gravity."""
        gravity = np.asarray(problem.gravity_m_s2, dtype=float)
        first, second = horizontal_axes(gravity)
        turn = Rotation.from_rotvec(self.tilt_x_rad * first + self.tilt_y_rad * second)
        return replace(problem, gravity_m_s2=(1.0 + self.magnitude) * turn.apply(gravity))


def horizontal_axes(gravity: Array) -> tuple[Array, Array]:
    """Two unit vectors across ``gravity`` (3,): x and y for gravity along -z."""
    down = gravity / np.linalg.norm(gravity)
    start = np.eye(3)[0] if abs(down[0]) < 0.9 else np.eye(3)[1]
    first = start - (start @ down) * down
    first /= np.linalg.norm(first)
    return first, np.cross(first, down)
