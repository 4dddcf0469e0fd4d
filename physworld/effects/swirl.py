"""A swirl: a field of force that goes round an axis and grows with the distance from it.

    a = s x (x - c)        s [1/s^2] along the axis, c a point of it [m], x the present place

To first order in space every steady field of force without a potential is a push and a swirl: air that goes round in a
room, a rotating magnet. The push is ``gravity_tilt`` or ``wind``, the part with a potential a ``tether``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.effects.base import Effect, Strength, Variant
from physworld.effects.on_mass import OnMass
from physworld.effects.places import body_size, gravity_size
from physworld.engine.problem import Problem
from physworld.engine.terms.term import BoundTerm

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@wp.kernel
def swirl(
    # model
    mass: wp.array[wp.float64],
    spin: wp.vec3d,
    centre: wp.vec3d,
    # in
    x: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Add m s x (x - c) at one node."""
    node = wp.tid()
    place = wp.vec3d(x[3 * node], x[3 * node + 1], x[3 * node + 2])
    push = wp.cross(spin, place - centre)
    for i in range(3):
        force[3 * node + i] += mass[node] * push[i]


@dataclass(frozen=True)
class SwirlTerm(OnMass):
    """Term of :class:`Swirl`: spin (3,) [1/s^2], a point of the axis (3,) [m]."""

    spin_per_s2: tuple[float, float, float]
    centre_m: tuple[float, float, float]

    def bound(self, mass: Any) -> BoundSwirl:
        """See :meth:`OnMass.bound`."""
        return BoundSwirl(mass, wp.vec3d(*self.spin_per_s2), wp.vec3d(*self.centre_m))


@dataclass(frozen=True)
class BoundSwirl(BoundTerm):
    """Masses of nodes or particles on the device; the field is far softer than the body."""

    mass: wp.array
    spin: wp.vec3d
    centre: wp.vec3d

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the push [N]."""
        inputs = [self.mass, self.spin, self.centre, x]
        wp.launch(swirl, dim=len(self.mass), inputs=inputs, outputs=[force], device=self.mass.device)


@dataclass(frozen=True)
class Swirl(Effect):
    """``spin_x_per_s2`` …: s [1/s^2]; ``centre_x_m`` …: c [m], by default the middle of the mass at the start."""

    name = "swirl"
    title = "swirling field of force"
    equation = "a = s x (x - c)"
    kind = "force"
    gates = ("spin_x_per_s2", "spin_y_per_s2", "spin_z_per_s2")

    spin_x_per_s2: float = 0.0
    spin_y_per_s2: float = 0.0
    spin_z_per_s2: float = 0.0
    centre_x_m: float | None = None
    centre_y_m: float | None = None
    centre_z_m: float | None = None

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to the weight half a body's size off the axis, which passes within a size of the body's middle."""
        size = body_size(twin)
        most = 2.0 * gravity_size(twin) / size
        return (
            *(Strength(f"spin_{a}_per_s2", "1/s^2", -most, most, 0.005 * most) for a in "xyz"),
            *(
                Strength(f"centre_{a}_m", "m", c - size, c + size, 0.02 * size, gate=False, start=c)
                for a, c in zip("xyz", _middle(twin), strict=True)
            ),
        )

    @classmethod
    def variants(cls, twin: Twin) -> list[Variant]:
        """About the body's middle: about another axis it is this and a push, which has names of its own."""
        middle = {f"centre_{a}_m": float(c) for a, c in zip("xyz", _middle(twin), strict=True)}
        return [Variant(cls.gates, fixed=middle)]

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the term."""
        given = (self.centre_x_m, self.centre_y_m, self.centre_z_m)
        centre = [m if c is None else c for c, m in zip(given, _middle(twin), strict=True)]
        spin = (self.spin_x_per_s2, self.spin_y_per_s2, self.spin_z_per_s2)
        return replace(problem, terms=(*problem.terms, SwirlTerm(spin, (centre[0], centre[1], centre[2]))))


def _middle(twin: Twin) -> Array:
    """Middle of the mass at the start, (3,) [m]."""
    middle: Array = np.average(twin.particles_start, axis=0, weights=twin.particle_mass)
    return middle
