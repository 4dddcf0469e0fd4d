"""Descents: what is asked of a search, what it found, and several of them side by side.

Descents of searches with the same controls (one recording of which each sees something else, such as the folds of a
cross-validation) send their simulations to the runner together. What is found is the same as one after the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.parameters import Parameter
from physworld.estimation.least_squares import most_runs
from physworld.estimation.simulations import idle_beside, in_turn

if TYPE_CHECKING:
    from physworld.calibrate.search import Search

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


def measured_together(asked: list[tuple[Search, Place]]) -> Iterator[tuple[Array, float | None]]:
    """Residuals and their root mean squares [m] of places of searches with one drive."""
    jobs = [search.job(place) for search, place in asked]
    made = asked[0][0].run(jobs) if asked else iter(())
    for (search, _), job, tracks in zip(asked, jobs, made, strict=True):
        yield search.compared(job, tracks)


def in_step(several: list[tuple[Search, Descent]]) -> list[Descended]:
    """Descents in step with each other: what all of them ask for next is run together.

    Processes that would wait meanwhile run what the descents will likely ask for after that. Such a run counts only
    once it is asked for.
    """
    asking = [search.begun(one) for search, one in several]
    asked = {k: next(one) for k, one in enumerate(asking)}
    runs, losses = [0] * len(several), [[] for _ in several]  # type: ignore[var-annotated]
    found: dict[int, Optimum] = {}
    known: dict[tuple[int, bytes], tuple[Array, float | None]] = {}
    while asked:
        needed = [(k, theta) for k, (places, _) in asked.items() for theta in places]
        missing = [(k, theta) for k, theta in needed if (k, theta.tobytes()) not in known]
        ahead = [
            (k, theta)
            for k, (_, likely) in asked.items()
            for theta in likely
            if (k, theta.tobytes()) not in known
        ]
        run = missing + ahead[: idle_beside(several[0][0].runner, len(missing))]
        places = [(several[k][0], (several[k][1].parameters, theta, several[k][1].end)) for k, theta in run]
        arriving = zip([(k, theta.tobytes()) for k, theta in run], measured_together(places), strict=True)
        for k in list(asked):
            search, one = several[k]
            residuals = []
            for theta in asked[k][0]:
                while (k, theta.tobytes()) not in known:
                    arrived, result = next(arriving)
                    known[arrived] = result
                residual, loss = known.pop((k, theta.tobytes()))
                runs[k] += 1
                if loss is not None:
                    if one.end in (None, search.end):
                        losses[k].append(loss)
                    search.tell(search.simulations + sum(runs), loss, (one.parameters, theta, None))
                residuals.append(residual)
            try:
                asked[k] = asking[k].send(residuals)
            except StopIteration as ended:
                found[k] = Optimum(ended.value.theta, ended.value.cost)
                del asked[k]
        known.update(arriving)
    return [Descended(found[k], runs[k], losses[k]) for k in range(len(several))]


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
