"""A camera that drifts: everything that it reports moves away at a constant velocity.

measured(t) = true(t) + u (t - t_0)        t_0: the first frame
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.effects.base import Effect, Strength

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class MeasurementDrift(Effect):
    """``x_m_s``, ``y_m_s``, ``z_m_s``: u [m/s]."""

    name = "measurement_drift"
    title = "drift of the camera"
    equation = "measured = true + u (t - t0)"
    kind = "measurement"
    gates = ("x_m_s", "y_m_s", "z_m_s")
    instead = "keep a fixed target in the picture"

    x_m_s: float = 0.0
    y_m_s: float = 0.0
    z_m_s: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to 5 cm/s."""
        return tuple(Strength(f"{axis}_m_s", "m/s", -0.05, 0.05, 1e-3) for axis in "xyz")

    def measured(self, times: Array, tracks: Array, twin: Twin) -> Array:
        """Shifted in proportion to the time."""
        velocity = np.array([self.x_m_s, self.y_m_s, self.z_m_s])
        shifted: Array = tracks + (times - times[0])[:, None, None] * velocity
        return shifted
