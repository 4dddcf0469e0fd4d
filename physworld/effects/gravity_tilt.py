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
from physworld.effects.base import Effect, Strength, Variant, one_by_one
from physworld.engine.problem import Problem

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


_LARGEST_TILT_RAD = 0.2
_LARGEST_MAGNITUDE = 0.01  # over the Earth gravity's strength differs by half as much
_MAGNITUDE_DEVIATION = (
    0.003  # from the equator to the poles and up a mountain, where only 9.81 m/s^2 is declared
)
_TILT_DEVIATION_RAD = 0.1
"""Who sets up a camera sees a frame that is far off the vertical before any recording.

A strong recording overrules that, and where it says a tilt that nobody believes that stays so. A weak one that hardly
tells a tilt of 3 degrees from one of 13 says the one that is believed.
"""


@dataclass(frozen=True)
class GravityTilt(Effect):
    """``tilt_x_rad``, ``tilt_y_rad``: a and b; ``magnitude``: s."""

    name = "gravity_tilt"
    title = "tilted gravity"
    equation = "g' = (1 + s) R(a e1 + b e2) g"
    kind = "force"
    gates = ("tilt_x_rad", "tilt_y_rad", "magnitude")
    instead = "hang a plumb line into the picture, or level the frame"

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
            Strength("tilt_x_rad", "rad", -0.5, 0.5, 0.01, prior_deviation=_TILT_DEVIATION_RAD),
            Strength("tilt_y_rad", "rad", -0.5, 0.5, 0.01, prior_deviation=_TILT_DEVIATION_RAD),
            Strength("magnitude", "1", -0.5, 0.5, 0.01, prior_deviation=_MAGNITUDE_DEVIATION),
        )

    @classmethod
    def variants(cls, twin: Twin) -> list[Variant]:
        """Direction and strength apart."""
        return one_by_one(cls.strengths(twin), ("tilt_x_rad", "tilt_y_rad"), ("magnitude",))

    def implausible(self) -> str | None:
        """A plumb line shows a frame that is far off the vertical before a recording does.

        Gravity's strength is known everywhere; a body that weighs less is carried by a fluid.
        """
        tilt = float(np.hypot(self.tilt_x_rad, self.tilt_y_rad))
        if tilt > _LARGEST_TILT_RAD:
            return f"gravity tilted by {np.degrees(tilt):.0f}° is not believed"
        if abs(self.magnitude) > _LARGEST_MAGNITUDE:
            return f"gravity that differs by {self.magnitude:+.0%} is not believed"
        return None

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
