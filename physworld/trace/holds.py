"""How hard grips hold: a refit started again from other softnesses, for stiffness and softness trade along a valley."""

from __future__ import annotations

import numpy as np

from physworld.mpm.soft_grips import AS_HELD
from physworld.trace.refit import Refit, refit
from physworld.trace.simulations import Simulations
from physworld.trace.unknowns import SOFTNESS
from physworld.trace.whitening import Whitener

_SHARES = (0.15, 0.4, 1.0)  # of ``AS_HELD``
_STIFFNESSES = (-0.3, -0.15, 0.0, 0.15)  # logarithms of the stiffness that may go with them


def held_otherwise(
    fitted: Refit, simulations: Simulations, whitener: Whitener, frames: int, iterations: int
) -> Refit:
    """The best refit from grips that hold harder and softer; itself where none is better or no softness is free."""
    names = [unknown.name for unknown in fitted.unknowns]
    if SOFTNESS not in names:
        return fitted
    k, best = names.index(SOFTNESS), fitted
    for share in _SHARES:
        places = [fitted.theta + shift * np.eye(len(names))[0] for shift in _STIFFNESSES]
        for place in places:
            place[k] = np.log(share * AS_HELD)
        unknowns = [u.starting(t) for u, t in zip(fitted.unknowns, places[0], strict=True)]
        other = refit(
            simulations, whitener, fitted.twin, unknowns, frames, iterations, places[1:],
            hopeless=2.0 * float(np.sum(best.residual**2)),
        )  # fmt: skip
        if other is not None and other.misfit < best.misfit:
            best = other
    return best
