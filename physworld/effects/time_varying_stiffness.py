"""Stiffness that changes in time: a body that warms up, dries or tires.

    stiffness(t) = exp(a t) stiffness(0)        t from the first frame of the recording

It multiplies the law's own forces, its friction with them, before any other term acts. The time step is that of the
stiffest moment of the run.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.effects.base import Effect, Strength
from physworld.engine.problem import Problem
from physworld.engine.terms.term import BoundTerm
from physworld.engine.total.forces import InternalForces
from physworld.engine.total.stability import fastest_frequency
from physworld.engine.updated.stress_kernels import grow_stress
from physworld.engine.updated.terms import BoundParticleStress, ParticleBody
from physworld.errors import CFLViolation

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_COVERED = 2.0  # growth of the stiffness that the stable time step's own margin covers


@wp.kernel
def scale_forces(
    # model
    times: wp.array[wp.float64],
    rate: wp.float64,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in, out
    force: wp.array[wp.float64],
) -> None:
    """Multiply one component of the internal forces by exp(rate t)."""
    k = wp.tid()
    time = times[counter[0]] + wp.float64(counter[1]) * clock[2]
    force[k] = force[k] * wp.exp(rate * time)


@dataclass(frozen=True)
class GrowingStiffness:
    """Term of :class:`TimeVaryingStiffness`; has to be the first of its problem."""

    rate_per_s: float

    def bind(self, problem: Problem) -> BoundGrowth:
        """Room for the times comes with the run; the time step is told what the stiffness grows to."""
        return BoundGrowth(self.rate_per_s, problem.device, *_faster(problem, self.rate_per_s))

    def on_particles(self, body: ParticleBody) -> BoundStressGrowth:
        """The same on particles' stresses."""
        return BoundStressGrowth(
            self.rate_per_s, body.problem.device, *_faster(body.problem, self.rate_per_s)
        )


@dataclass
class BoundGrowth(BoundTerm):
    """The rate, and the frames' times on the device once a run has begun."""

    rate_per_s: float
    device: str
    covered: float
    frequency_rad_s: float
    friction_per_s: float
    times: wp.array | None = None
    multiplies: bool = True

    def begin(self, times: Array) -> None:
        """Take the times. Raises CFLViolation where the stiffness would outgrow the time step."""
        _check(times, self.rate_per_s, self.covered)
        self.times = wp.array(times, dtype=wp.float64, device=self.device)

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Multiply the forces that are there."""
        inputs = [self.times, wp.float64(self.rate_per_s), clock, counter]
        wp.launch(scale_forces, dim=len(force), inputs=inputs, outputs=[force], device=self.device)


class BoundStressGrowth(BoundParticleStress):
    """The rate on particles: each stress is multiplied in the substep that uses it.

    Args:
        rate_per_s: a of the factor exp(a t) [1/s].
        device: of Warp.
        covered: largest growth of the stiffness that the stable time step allows for; more of it is refused.
        frequency_rad_s: what the growth adds to the fastest mode [rad/s].
        friction_per_s: what it adds to the fastest friction [1/s].
    """

    def __init__(
        self, rate_per_s: float, device: str, covered: float, frequency_rad_s: float, friction_per_s: float
    ) -> None:
        self._rate, self._device, self._covered = rate_per_s, device, covered
        self.frequency_rad_s, self.friction_per_s = frequency_rad_s, friction_per_s
        self._times = wp.zeros(1, dtype=wp.float64, device=device)

    def begin(self, times: Array) -> None:
        """Take the times. Raises CFLViolation where the stiffness would outgrow the time step."""
        _check(times, self._rate, self._covered)
        self._times = wp.array(times, dtype=wp.float64, device=self._device)

    def launch(self, F: wp.array, stress: wp.array, clock: wp.array, counter: wp.array) -> None:
        """Multiply the stresses that are there."""
        inputs = [self._times, wp.float64(self._rate), clock, counter]
        wp.launch(grow_stress, dim=len(stress), inputs=inputs, outputs=[stress], device=self._device)


def _growth(rate_per_s: float, times: Array) -> float:
    """Largest stiffness over the first frame's, at ``times``."""
    return float(np.exp(rate_per_s * times).max())


def _faster(problem: Problem, rate_per_s: float) -> tuple[float, float, float]:
    """Growth that the time step has to cover, and what it adds to the fastest mode and to the fastest friction."""
    growth = 1.0 if problem.span_s is None else _growth(rate_per_s, np.array(problem.span_s))
    if growth <= _COVERED:
        return _COVERED, 0.0, 0.0
    lattice, mass, cell = problem.lattice, problem.nodal_mass(), float(problem.lattice.spacing.min())
    stiffness = np.ones(lattice.fill.size) if problem.stiffness_factor is None else problem.stiffness_factor
    squares = [0.0, 0.0]  # of the fastest modes of the law and of its friction alone
    for k, law in enumerate((problem.law, problem.law.friction_law)):
        if law is not None:
            forces = InternalForces(lattice, law, stiffness, problem.rest, problem.device)
            squares[k] = fastest_frequency(forces, problem.rest, mass, cell) ** 2
    more = growth - _COVERED
    return growth, float(np.sqrt(more * squares[0])), more * squares[1]


def _check(times: Array, rate_per_s: float, covered: float) -> None:
    growth = _growth(rate_per_s, times)
    if growth > covered * (1 + 1e-9):
        raise CFLViolation(
            f"the stiffness grows {growth:.3g} times by a rate of {rate_per_s:.3g} 1/s until {times[-1]:.3g} s; the "
            f"time step covers {covered:.3g}"
        )


@dataclass(frozen=True)
class TimeVaryingStiffness(Effect):
    """``log_rate_per_s``: a [1/s]."""

    name = "time_varying_stiffness"
    title = "stiffness that changes in time"
    equation = "stiffness(t) = exp(a t) stiffness(0)"
    kind = "field"
    gates = ("log_rate_per_s",)

    log_rate_per_s: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to a factor e in two seconds."""
        return (Strength("log_rate_per_s", "1/s", -0.5, 0.5, 0.02),)

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """Discrete rods: their forces are no launch of their own that could be scaled."""
        return (
            None if twin.natural is None else f"the stiffness of {twin.lattice.title} does not change in time"
        )

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Puts the term before the others."""
        return replace(problem, terms=(GrowingStiffness(self.log_rate_per_s), *problem.terms))
