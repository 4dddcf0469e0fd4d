"""Effects that the library lacks, for ``benchmarks.trace.outside``: no trace may know them, so none is in the registry.

``among_the_known()`` lends them to the registry while a recording is made.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import warp as wp
from scipy.interpolate import PchipInterpolator

from physworld.effects.base import Effect, Strength
from physworld.effects.places import body_size, middle_of_free_end
from physworld.effects.registry import EFFECTS
from physworld.engine.problem import Problem
from physworld.engine.terms.term import BoundTerm

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_BESIDE = 0.01  # body sizes from the body at the start to a wall
_ALWAYS = (-1.0, 1e9)


@wp.kernel
def push_from_outside(
    # model
    mass: wp.array(dtype=wp.float64),
    times: wp.array(dtype=wp.float64),
    push: wp.vec3d,
    window: wp.vec2d,
    pace: wp.float64,
    magnet: wp.float64,
    centre: wp.vec3d,
    wall: wp.float64,
    stiff: wp.float64,
    clock: wp.array(dtype=wp.float64),
    counter: wp.array(dtype=wp.int32),
    # in
    x: wp.array(dtype=wp.float64),
    # out
    force: wp.array(dtype=wp.float64),
):
    """Add m (push cos(pace t) + magnet (centre - place) / |centre - place|^3 + a wall's push) at one node, within the
    window."""
    node = wp.tid()
    time = times[counter[0]] + wp.float64(counter[1]) * clock[2]
    if time < window[0] or time >= window[1]:
        return
    way = centre - wp.vec3d(x[3 * node], x[3 * node + 1], x[3 * node + 2])
    far = wp.length(way)
    pull = wp.cos(pace * time) * push
    if magnet > wp.float64(0.0):
        pull += (magnet / (far * far * far)) * way
    if wall > x[3 * node + 1]:
        pull += wp.vec3d(wp.float64(0.0), stiff * (wall - x[3 * node + 1]), wp.float64(0.0))
    for i in range(3):
        force[3 * node + i] += mass[node] * pull[i]


@dataclass(frozen=True)
class Push:
    """Term of the forces below: what acts on every kilogram [m/s^2], and when."""

    push: tuple[float, float, float] = (0.0, 0.0, 0.0)
    window_s: tuple[float, float] = _ALWAYS
    pace_rad_s: float = 0.0
    magnet_m3_s2: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wall_per_s2: float = 0.0
    wall_y_m: float = -np.inf

    def bind(self, problem: Problem) -> BoundPush:
        """Device arrays."""
        mass = wp.array(problem.nodal_mass(), dtype=wp.float64, device=problem.device)
        return BoundPush(self, mass, float(np.sqrt(self.wall_per_s2)))


@dataclass
class BoundPush(BoundTerm):
    """Masses on the device, and the frames' times once a run has begun."""

    law: Push
    mass: wp.array
    frequency_rad_s: float
    times: wp.array | None = None

    def begin(self, times: np.ndarray) -> None:
        """Take the times."""
        self.times = wp.array(times, dtype=wp.float64, device=self.mass.device)

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the forces [N]."""
        law = self.law
        inputs = [
            self.mass, self.times, wp.vec3d(*law.push), wp.vec2d(*law.window_s), wp.float64(law.pace_rad_s),
            wp.float64(law.magnet_m3_s2), wp.vec3d(*law.centre), wp.float64(law.wall_y_m), wp.float64(law.wall_per_s2),
            clock, counter, x,
        ]  # fmt: skip
        wp.launch(
            push_from_outside, dim=len(self.mass), inputs=inputs, outputs=[force], device=self.mass.device
        )


@dataclass(frozen=True)
class Outside(Effect):
    """``size``: of what acts, in the unit of :attr:`unit`."""

    kind = "force"
    gates = ("size",)
    unit: ClassVar[str] = "m/s^2"
    probe: ClassVar[float] = 0.1

    size: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """One, hardly bounded."""
        return (Strength("size", cls.unit, 0.0, 1e4 * cls.probe, cls.probe),)

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the term."""
        return replace(problem, terms=(*problem.terms, self.term(twin)))

    def term(self, twin: Twin) -> Push:
        """What acts."""
        raise NotImplementedError(f"{type(self).__name__} has no force")


@dataclass(frozen=True)
class Gust(Outside):
    """A push of a tenth of a second."""

    name = "gust"
    title = "a gust"
    equation = "a = size n for 0.3 s <= t < 0.4 s"

    def term(self, twin: Twin) -> Push:
        """Sideways."""
        return Push(push=(0.36 * self.size, 0.8 * self.size, 0.48 * self.size), window_s=(0.3, 0.4))


@dataclass(frozen=True)
class Shaking(Outside):
    """The camera and the room shake at 4 Hz."""

    name = "shaking"
    title = "a frame that shakes"
    equation = "a = size n cos(w t), w = 25 rad/s"

    def term(self, twin: Twin) -> Push:
        """An accelerated frame's force."""
        return Push(push=(0.48 * self.size, 0.6 * self.size, 0.64 * self.size), pace_rad_s=25.0)


@dataclass(frozen=True)
class Magnet(Outside):
    """A point beside the body that draws all of it, the more the nearer."""

    name = "magnet"
    title = "a magnet"
    equation = "a = size (c - x) / |c - x|^3"
    unit = "m^3/s^2"
    probe = 1e-3

    def term(self, twin: Twin) -> Push:
        """Half a body's size beside its free end."""
        x, y, z = middle_of_free_end(twin) + 0.5 * body_size(twin) * np.array([0.36, 0.8, -0.48])
        return Push(magnet_m3_s2=self.size, centre=(x, y, z))


@dataclass(frozen=True)
class Wall(Outside):
    """A smooth, soft wall close beside the body."""

    name = "wall"
    title = "a wall in the way"
    equation = "a = size max(w - y, 0) along y, w a hundredth of the body's size beside it"
    unit = "1/s^2"
    probe = 10.0

    def term(self, twin: Twin) -> Push:
        """On the side of -y."""
        beside = float(twin.particles_start[:, 1].min()) - _BESIDE * body_size(twin)
        return Push(wall_per_s2=self.size, wall_y_m=beside)


@dataclass(frozen=True)
class RollingShutter(Outside):
    """A camera whose lower rows are read later."""

    name = "rolling_shutter"
    title = "a rolling shutter"
    equation = "measured(t) = true(t + size s), s: share of the picture's height, from the top"
    kind = "measurement"
    unit = "s"
    probe = 0.005

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Nothing acts."""
        return problem

    def measured(self, times: np.ndarray, tracks: np.ndarray, twin: Twin) -> np.ndarray:
        """Every point is read at its own time."""
        low, high = tracks[0, :, 2].min(), tracks[0, :, 2].max()
        late = self.size * (high - tracks[0, :, 2]) / max(high - low, 1e-9)
        seen = tracks.copy()
        for point, delay in enumerate(late):
            way = PchipInterpolator(times, tracks[:, point], axis=0)
            seen[:, point] = way(np.clip(times + delay, times[0], times[-1]))
        return seen


OUTSIDE: tuple[type[Outside], ...] = (Gust, Shaking, Magnet, Wall, RollingShutter)


@contextmanager
def among_the_known() -> Iterator[None]:
    """The registry holds them too."""
    EFFECTS.update({kind.name: kind for kind in OUTSIDE})
    try:
        yield
    finally:
        for kind in OUTSIDE:
            del EFFECTS[kind.name]
