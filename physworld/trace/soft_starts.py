"""Softer grips: where a refit starts again, since from grips that hold all nodes no derivative leads to them."""

from __future__ import annotations

import numpy as np

from physworld.trace.refit import Refit, refit
from physworld.trace.simulations import Simulations
from physworld.trace.unknowns import SOFTNESS
from physworld.trace.whitening import Whitener

_SOFTNESS = (1 / 100, 1 / 40, 1 / 16)  # cells
_HOPELESS = 2.0  # times the best squared residual: such a search is left after two iterations
_STIFFER = (0.0, 0.24, 0.48)  # logarithms of the stiffness: held less, a body has to be stiffer


def soft_places(fitted: Refit) -> list[np.ndarray]:
    """Places (p,) with softer grips than the optimum's and stiffnesses that may go with them; none without grips."""
    names = [unknown.name for unknown in fitted.unknowns]
    if SOFTNESS not in names:
        return []
    k = names.index(SOFTNESS)
    found = []
    for softness in _SOFTNESS:
        for shift in _STIFFER:
            place = fitted.theta.copy()
            place[k] = np.log(softness)
            place[0] += shift
            found.append(place)
    return found


def softer(
    fitted: Refit, simulations: Simulations, whitener: Whitener, frames: int, iterations: int
) -> Refit:
    """The refit started again with softer grips if that is better; else itself.

    The best start of every stiffness is followed: at another stiffness the phase may have slipped by a period.
    """
    places = soft_places(fitted)
    best = fitted
    for first in range(len(_STIFFER) if places else 0):
        starts = places[first :: len(_STIFFER)]
        unknowns = [u.starting(t) for u, t in zip(fitted.unknowns, starts[0], strict=True)]
        other = refit(
            simulations, whitener, fitted.twin, unknowns, frames, iterations, starts[1:],
            hopeless=_HOPELESS * float(np.sum(best.residual**2)),
        )  # fmt: skip
        if other is not None and other.misfit < best.misfit:
            best = other
    return best
