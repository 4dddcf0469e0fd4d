"""Actuation lag: the grips do at time t what the recorded controllers did at t - lag.

A pure delay, by interpolation of the control track (cubic, shape preserving); before the first record the grip stands
where it was first seen. A first-order lag of the same time constant differs from it by terms of second order in
lag times the bandwidth of the motion, which a recording of slow motions cannot show. A clock offset between the
controllers' and the camera's records is the same thing up to the start: the two are always one equivalent set.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from physworld.arrays import Array
from physworld.effects.base import Effect, Strength

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class ActuationLag(Effect):
    """``lag_s``: delay [s]; negative where the grip runs ahead of its record."""

    name = "actuation_lag"
    title = "actuation lag"
    equation = "grip(t) = record(t - lag)"
    kind = "boundary"
    gates = ("lag_s",)
    instead = "put a marker on the grip itself and compare it with the commanded track"

    lag_s: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to 0.3 s."""
        return (Strength("lag_s", "s", -0.05, 0.3, 0.005),)

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """A body that nobody holds follows no controller; when a late hand lets go is not known."""
        if twin.openings:
            return f"{sum(one is not None for one in twin.openings)} of the grips let go"
        held = sum(len(nodes) for nodes in twin.held_nodes)
        return f"{held} nodes are held: no grip that could lag" if held == 0 else None

    def controls(self, times: Array, points: Array) -> tuple[Array, Array]:
        """The same points, later."""
        return times + self.lag_s, points
