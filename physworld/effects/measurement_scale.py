"""A camera whose scale is off: distances of tracked points come out too long or too short by a share.

    measured = c + (1 + s) (true - c)        c: middle of the controllers at the start

The controllers are taken as right (they are commanded, or seen by something else). Looks like a wrong stiffness.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from physworld.effects.base import Effect, Strength

if TYPE_CHECKING:
    from physworld.twin import Twin


@dataclass(frozen=True)
class MeasurementScale(Effect):
    """``scale``: s."""

    name = "measurement_scale"
    title = "scale of the camera"
    equation = "measured = c + (1 + s) (true - c)"
    kind = "measurement"
    gates = ("scale",)

    scale: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """A fifth either way."""
        return (Strength("scale", "1", -0.2, 0.2, 0.005),)

    def measured(self, times: np.ndarray, tracks: np.ndarray, twin: Twin) -> np.ndarray:
        """Stretched about the grip, or about the body's middle where nobody holds it."""
        start = twin.controllers_start if len(twin.controllers_start) else twin.particles_start
        centre = start.mean(axis=0)
        return centre + (1.0 + self.scale) * (tracks - centre)
