"""A tracker that smooths: what it reports follows the truth with a time constant.

    tau dy/dt = true - y        y(t_0) = true(t_0)

Causal, as a tracker that runs live is; solved exactly for a truth that is linear between frames. It delays slow
motions by tau (as ``measurement_clock`` does) and takes from the amplitude of fast ones (as damping does).
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
class MeasurementSmoothing(Effect):
    """``time_constant_s``: tau [s]."""

    name = "measurement_smoothing"
    title = "smoothing of the tracker"
    equation = "tau dy/dt = true - y"
    kind = "measurement"
    gates = ("time_constant_s",)
    instead = "look at the tracker's raw detections, or film a falling ball with it"

    time_constant_s: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to 0.3 s."""
        return (Strength("time_constant_s", "s", 0.0, 0.3, 0.005),)

    def measured(self, times: Array, tracks: Array, twin: Twin) -> Array:
        """Filtered, frame after frame."""
        tau, out = self.time_constant_s, tracks.copy()
        if tau <= 0:
            return out
        for frame in range(1, len(times)):
            step = times[frame] - times[frame - 1]
            slope = (tracks[frame] - tracks[frame - 1]) / step
            behind = out[frame - 1] - tracks[frame - 1] + tau * slope
            out[frame] = tracks[frame] - tau * slope + behind * np.exp(-step / tau)
        return out
