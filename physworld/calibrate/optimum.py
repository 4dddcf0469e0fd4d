"""What a search is asked for, and what it found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.parameters import Parameter

Place = tuple[list[Parameter], Array, int | None]
"""Parameters, their values in the scale of the search, and the end of the frames (None: all training frames)."""


@dataclass(frozen=True)
class Optimum:
    """Where a descent ended: theta (p,) in the scale of the search, and the mean squared residual there [m^2]."""

    theta: Array
    cost: float


@dataclass(frozen=True)
class Descent:
    """A descent that is asked for: what it searches, from where, in how many iterations, over frames up to ``end``."""

    parameters: list[Parameter]
    theta: Array
    iterations: int
    end: int | None = None


@dataclass(frozen=True)
class Descended:
    """A descent that was done beside others: what it found, its runs, and the losses [m] over all training frames."""

    optimum: Optimum
    runs: int
    losses: list[float]


def cost_of(optimum: Optimum) -> float:
    """Its cost, infinite where it is not a number: a key to sort by."""
    return optimum.cost if np.isfinite(optimum.cost) else float("inf")
