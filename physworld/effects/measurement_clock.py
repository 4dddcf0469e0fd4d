"""A camera whose clock is off: a frame stamped t shows the body at t - offset.

    measured(t) = true(t - offset)

Cubic between frames (shape preserving); before the first frame the body stands, after the last one it keeps its last
velocity. Up to the start this is ``actuation_lag``: the two are one equivalent set.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import PchipInterpolator

from physworld.arrays import Array
from physworld.effects.base import Effect, Strength

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class MeasurementClock(Effect):
    """``offset_s``: how late the stamps are [s]."""

    name = "measurement_clock"
    title = "clock of the camera"
    equation = "measured(t) = true(t - offset)"
    kind = "measurement"
    gates = ("offset_s",)
    instead = "record one event that both clocks see (a flash, a tap on the grip)"

    offset_s: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to 0.3 s."""
        return (Strength("offset_s", "s", -0.3, 0.3, 0.005),)

    def measured(self, times: Array, tracks: Array, twin: Twin) -> Array:
        """Read at other times."""
        if len(times) < 2:
            return tracks
        wanted = times - self.offset_s
        inside = PchipInterpolator(times, tracks, axis=0)(np.clip(wanted, times[0], times[-1]))
        beyond = np.maximum(wanted - times[-1], 0.0)[:, None, None]
        shifted: Array = inside + beyond * (tracks[-1] - tracks[-2]) / (times[-1] - times[-2])
        return shifted
