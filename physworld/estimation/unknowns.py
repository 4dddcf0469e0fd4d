"""An unknown of an inference: a number of a twin that data shall fix, and how it is searched.

A calibration searches parameters, a trace parameters and strengths of effects. Whatever it is, an unknown has a name, a
unit and bounds in that unit, a transform to the scale in which it is searched (a logarithm, or a multiple of a unit of
its own), a step for finite differences and perhaps a Gaussian prior, both in the scale of the search, and a way into
the twin. Vectors ``theta`` (p,) are in the scale of the search.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from physworld.arrays import Array
from physworld.twin.twin import Twin


@dataclass(frozen=True)
class Transform:
    """From a number in its unit to the scale of its search, and back."""

    name: str
    searched: Callable[[float], float]
    value: Callable[[float], float]


LOG = Transform("log", lambda value: float(np.log(value)), lambda searched: float(np.exp(searched)))
LINEAR = Transform("linear", float, float)


def multiple_of(unit: float) -> Transform:
    """The scale in which a number is a multiple of ``unit``."""
    return Transform("linear", lambda value: float(value / unit), lambda searched: float(searched * unit))


@dataclass(frozen=True)
class Unknown:
    """One number.

    Attributes:
        name: of the parameter, or ``effect.strength``.
        unit: SI unit.
        low, high: bounds, in its unit.
        apply: a twin with this value, in its unit.
        transform: to the scale of the search.
        step: of finite differences, in the scale of the search.
        start: where a descent begins, in the scale of the search.
        prior: mean and deviation in the scale of the search of what is known beforehand, or None.
    """

    name: str
    unit: str
    low: float
    high: float
    apply: Callable[[Twin, float], Twin]
    transform: Transform = LINEAR
    step: float = 1.0
    start: float = 0.0
    prior: tuple[float, float] | None = None

    @property
    def bounds(self) -> tuple[float, float]:
        """In the scale of the search."""
        return self.transform.searched(self.low), self.transform.searched(self.high)

    @property
    def probe(self) -> float:
        """The signed step of finite differences at the start: downwards where the upper bound is nearer than it."""
        return -self.step if self.start + self.step > self.bounds[1] else self.step

    def searched(self, value: float) -> float:
        """A value in the scale of the search."""
        return self.transform.searched(value)

    def value(self, searched: float) -> float:
        """The inverse of :meth:`searched`."""
        return self.transform.value(searched)

    def at(self, twin: Twin, searched: float) -> Twin:
        """The twin with the number at this place of the search."""
        return self.apply(twin, self.transform.value(searched))

    def starting(self, start: float) -> Self:
        """The same from another start in the scale of the search, clipped to the bounds."""
        return replace(self, start=float(np.clip(start, *self.bounds)))


def bounds_of(unknowns: Sequence[Unknown]) -> tuple[Array, Array]:
    """Lower and upper bounds in the scale of the search, (p,) each."""
    ends = [unknown.bounds for unknown in unknowns]
    return np.array([low for low, _ in ends]), np.array([high for _, high in ends])


def starts_of(unknowns: Sequence[Unknown]) -> Array:
    """Where a descent begins, (p,)."""
    return np.array([unknown.start for unknown in unknowns])


def starting_at(unknowns: Sequence[Unknown], theta: Array) -> list[Unknown]:
    """The unknowns from the place ``theta`` (p,)."""
    return [unknown.starting(start) for unknown, start in zip(unknowns, theta, strict=True)]


def at(twin: Twin, unknowns: Sequence[Unknown], theta: Array) -> Twin:
    """The twin with every unknown at its place, ``theta`` (p,)."""
    for unknown, searched in zip(unknowns, theta, strict=True):
        twin = unknown.at(twin, float(searched))
    return twin
