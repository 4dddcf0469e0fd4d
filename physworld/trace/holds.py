"""How grips hold: a refit started again from others, for stiffness and hold trade along a valley.

A grip may be softer or harder, a clamp may reach farther or less far; what fits best on one side of where a lattice
has its nodes is another valley than on the other. Scouts go first, without a Jacobian of their own; the best is
refitted from where it ends, if it comes near.
"""

from __future__ import annotations

import numpy as np

from physworld.engine.terms.soft_grips import AS_HELD
from physworld.estimation.refit import Refit, refit
from physworld.estimation.simulations import Simulations
from physworld.estimation.whitening import Whitener
from physworld.trace.unknowns import REACH, SOFTNESS

_SHARES = (0.15, 0.4, 1.0)  # of ``AS_HELD``
_REACHES = (-1.0, 1.0)  # in steps of the reach, quarters of a cell
_SCOUTED = 2  # times the iterations of a refit: a scout's steps are cheap
_POLISHED = 1  # iterations of the best scout's refit: it has come to the optimum already
_PROMISING = 1.5  # times the squared residual of what there is up to which the best scout is followed
_STIFFNESSES = (-0.3, -0.15, 0.0, 0.15)  # logarithms of the stiffness that may go with them


def held_otherwise(
    fitted: Refit, simulations: Simulations, whitener: Whitener, frames: int, iterations: int
) -> Refit:
    """The best refit from grips that hold harder and softer; itself where none is better or no softness is free."""
    values = [float(np.log(share * AS_HELD)) for share in _SHARES]
    return _scouted(fitted, SOFTNESS, values, simulations, whitener, frames, iterations)


def clamped_otherwise(
    fitted: Refit, simulations: Simulations, whitener: Whitener, frames: int, iterations: int
) -> Refit:
    """The best refit from clamps that reach less far and farther; itself where none is better or no reach is free."""
    return _scouted(fitted, REACH, list(_REACHES), simulations, whitener, frames, iterations)


def _scouted(
    fitted: Refit,
    name: str,
    values: list[float],
    simulations: Simulations,
    whitener: Whitener,
    frames: int,
    iterations: int,
) -> Refit:
    """The best refit from these values of the unknown of that name, each with several stiffnesses, if it is better."""
    names = [unknown.name for unknown in fitted.unknowns]
    if name not in names:
        return fitted
    k, scouts = names.index(name), []
    limit = _PROMISING * float(np.sum(fitted.residual**2))
    for value in values:
        places = [fitted.theta + shift * np.eye(len(names))[0] for shift in _STIFFNESSES]
        for place in places:
            place[k] = value
        unknowns = [u.starting(t) for u, t in zip(fitted.unknowns, places[0], strict=True)]
        scout = refit(
            simulations, whitener, fitted.twin, unknowns, frames, _SCOUTED * iterations, places[1:],
            hopeless=limit, jacobian=fitted.jacobian,
        )  # fmt: skip
        scouts += [] if scout is None else [scout]
    scout = min(scouts, key=lambda s: s.misfit, default=None)
    if scout is None or float(np.sum(scout.residual**2)) > limit:
        return fitted
    other = refit(simulations, whitener, fitted.twin, scout.unknowns, frames, _POLISHED)
    return fitted if other is None or other.misfit >= fitted.misfit else other
