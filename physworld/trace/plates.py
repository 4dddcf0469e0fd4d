"""Sheets that bend as they were declared: a model without numbers of its own for bending, where it does as well.

How a sheet bends beside how it stretches, and twists beside how it bends, is calibrated (a mesh of hinges is no plate).
An effect that a sheet lacks is first answered by those numbers, and what they took they keep while the effect is
refitted: fibres of a slab came out a third too weak beside a bending stiffness a quarter too high. So the leading
models are refitted as homogeneous plates too, and of two that predict left-out blocks alike the simpler one is taken.
"""

from __future__ import annotations

import numpy as np

from physworld.calibrate.parameters import BENDING_RATIO, TWIST_RATIO
from physworld.estimation.refit import Refit, refit
from physworld.estimation.simulations import Simulations
from physworld.estimation.unknowns import at
from physworld.estimation.whitening import Whitener

OWN = (TWIST_RATIO, BENDING_RATIO)
_PLATE = 0.0  # logarithm of both ratios of a homogeneous plate


def as_a_plate(
    fitted: Refit, simulations: Simulations, whitener: Whitener, frames: int, iterations: int
) -> Refit | None:
    """The refit with both ratios of bending at a homogeneous plate's; None where none is free, or none could be run.

    It is searched from the same stiffness of the membrane, from the same stiffness of bending, and from between.
    """
    names = [unknown.name for unknown in fitted.unknowns]
    own = [k for k, name in enumerate(names) if name in OWN]
    if not own:
        return None
    theta = fitted.theta.copy()
    theta[own] = _PLATE
    twin = at(fitted.twin, fitted.unknowns, theta)
    kept = np.delete(np.arange(len(names)), own)
    bends = float(fitted.theta[names.index(BENDING_RATIO)]) if BENDING_RATIO in names else 0.0
    starts = [theta[kept] + share * bends * np.eye(len(kept))[0] for share in (0.0, 0.5, 1.0)]
    unknowns = [fitted.unknowns[k].starting(t) for k, t in zip(kept, starts[0], strict=True)]
    return refit(simulations, whitener, twin, unknowns, frames, iterations, starts[1:])
