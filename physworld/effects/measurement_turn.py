"""A camera whose frame is turned against the grips': displacements are seen in other directions.

    measured(t) = x(0) + d + w x d        d = true(t) - x(0), to first order in the angles w

Hand-eye calibrations are a few degrees off, and a body that is carried far shows it. Frame 0, which places the tracked
points, comes from the same camera and is as measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.effects.base import Effect, Strength

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_DEVIATION_RAD = 0.035  # two degrees, to which hand-eye calibrations are known


@dataclass(frozen=True)
class MeasurementTurn(Effect):
    """``x_rad``, ``y_rad``, ``z_rad``: w [rad]."""

    name = "measurement_turn"
    title = "turn of the camera"
    equation = "measured = x(0) + d + w x d, d = true - x(0)"
    kind = "measurement"
    gates = ("x_rad", "y_rad", "z_rad")
    instead = "carry a marker on the grip through the room and compare it with the record of the grip"

    x_rad: float = 0.0
    y_rad: float = 0.0
    z_rad: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to 9 degrees."""
        return tuple(
            Strength(gate, "rad", -0.15, 0.15, 0.005, prior_deviation=_DEVIATION_RAD) for gate in cls.gates
        )

    def measured(self, times: Array, tracks: Array, twin: Twin) -> Array:
        """Displacements turned."""
        moved = tracks - twin.track_nodes(twin.carriers_start[None])
        turned: Array = tracks + np.cross([self.x_rad, self.y_rad, self.z_rad], moved)
        return turned
