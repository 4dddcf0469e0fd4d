"""A camera whose scale is off: distances of tracked points come out too long or too short by a share.

    measured = c + (1 + s) (true - c)        c: middle of the controllers at the start

The controllers are taken as right (they are commanded, or seen by something else). Looks like a wrong stiffness.

Frame 0, which places the tracked points on the body, comes from the same camera. A solid's box or volume is declared:
its points sit at c + (p - c) / (1 + s) where p was measured. A sheet or rod is as long as its points show it, so they
keep their places on it, and c is each point's own start. Either way frame 0 is predicted as it was measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from physworld.arrays import Array
from physworld.effects.base import Effect, Strength

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@dataclass(frozen=True)
class MeasurementScale(Effect):
    """``scale``: s."""

    name = "measurement_scale"
    title = "scale of the camera"
    equation = "measured = c + (1 + s) (true - c)"
    kind = "measurement"
    gates = ("scale",)
    instead = "film a rod of known length in the same place"

    scale: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """A fifth either way."""
        return (Strength("scale", "1", -0.2, 0.2, 0.005),)

    def followed(self, twin: Twin) -> Twin:
        """A solid with its tracked points where they are, not where frame 0 shows them."""
        if twin.lattice.dim < 3:
            return twin
        centre = _centre(twin)
        points = centre + (twin.body.points - centre) / (
            1.0 + self.scale
        )  # material coordinates are the start's
        return replace(twin, body=replace(twin.body, points=points))

    def measured(self, times: Array, tracks: Array, twin: Twin) -> Array:
        """Stretched about the centre."""
        centre = _centre(twin)
        return centre + (1.0 + self.scale) * (tracks - centre)


def _centre(twin: Twin) -> Array:
    """What the camera shows in its true place [m], (3,) or (N, 3): see the module's text; unheld solids' middle."""
    if twin.lattice.dim < 3:
        points: Array = twin.track_nodes(twin.body.start[None])[0]
        return points
    start = twin.controllers_start if len(twin.controllers_start) else twin.particles_start
    middle: Array = start.mean(axis=0)
    return middle
