"""Searches of one recording of which each sees something else of it (the folds of a cross-validation), side by side.

Their simulations are under the same controls, so a runner may share them as it shares those of one search.
"""

from __future__ import annotations

from physworld.arrays import Array
from physworld.calibrate.optimum import Descent, Optimum, Place
from physworld.calibrate.search import Search
from physworld.calibrate.side_by_side import in_step, measured_together
from physworld.estimation.least_squares import most_runs
from physworld.estimation.simulations import in_turn


def solve_apart(asked: list[tuple[Search, Descent]]) -> list[Optimum]:
    """Optima of descents of searches whose scenes differ by what is seen in them alone.

    Side by side where their runner shares its simulations and each keeps within its own budget; what is found is the
    same. Nothing is journalled.
    """
    worst = max((most_runs(len(one.parameters), one.iterations) for _, one in asked), default=0)
    if any(search.runner is in_turn or worst > search.limit for search, _ in asked):
        return [search.solve(one.parameters, one.theta, one.iterations, one.end) for search, one in asked]
    return [made.optimum for made in in_step(asked)]


def residuals_apart(asked: list[tuple[Search, Place]]) -> list[Array]:
    """Residuals [m] of places of such searches; NaN where the run failed. Nothing is counted."""
    return [residual for residual, _ in measured_together(asked)]
