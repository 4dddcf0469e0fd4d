"""Refit: calibrated parameters and strengths together with the full simulator, by Gauss-Newton on whitened residuals.

Linear strengths are not to be trusted (an effect of 1.5 may look like 2.0 while the stiffness still absorbs part of
it), so nothing is named before this. The simulations of one Jacobian, and those of one line search, are independent of
each other and go to the runner together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.estimation.least_squares import damped
from physworld.estimation.simulations import Job, Simulations
from physworld.estimation.unknowns import Unknown, at, bounds_of, starting_at, starts_of
from physworld.estimation.whitening import Whitening
from physworld.twin.twin import Twin

_SCALES = (1.0, 0.3)  # of a Gauss-Newton step, tried together
_PAYS = (
    0.3  # relative fall of the cost from which a step is followed by another with the sensitivities corrected
)
_TOLERANCE = 2e-3  # relative fall of the cost that ends the search
_BOUND = 1e-6
_PATIENCE = 2  # iterations before a search is judged hopeless


@dataclass(frozen=True)
class Refit:
    """An optimum.

    Attributes:
        unknowns: what was estimated, starting at the optimum.
        twin: at the optimum.
        theta: (p,).
        tracks: of the training frames, (frames, N, 3) [m].
        residual: whitened, (M,).
        jacobian: of the prediction, whitened, (M, p), at or one step before the optimum.
    """

    unknowns: list[Unknown]
    twin: Twin
    theta: Array
    tracks: Array
    residual: Array
    jacobian: Array

    @property
    def misfit(self) -> float:
        """Root mean squared whitened residual: 1 for a perfect model."""
        return float(np.sqrt(np.mean(self.residual**2)))

    def value(self, name: str) -> float:
        """The number of that name."""
        names = [unknown.name for unknown in self.unknowns]
        k = names.index(name)
        return self.unknowns[k].value(float(self.theta[k]))


def refit(
    simulations: Simulations,
    whitener: Whitening,
    twin: Twin,
    unknowns: list[Unknown],
    frames: int,
    iterations: int,
    starts: list[Array] | None = None,
    hopeless: float = np.inf,
    jacobian: Array | None = None,
) -> Refit | None:
    """Minimise the whitened misfit and the priors over the unknowns, from the best of the starts.

    Args:
        starts: places (p,) to try first, beside the unknowns' own.
        hopeless: squared residual (sum) above which the search is left after two iterations: what it is compared with
            does far better.
        jacobian: sensitivities where the search begins, (M, p), if they are known; with ``starts`` they are not.

    Steps tell how sensitivities change (Broyden, Math. Comp. 19, 1965, 577-593), so new ones are only simulated where
    a step with the old ones did not pay.

    Returns:
        The optimum; None where no start gave a usable run.
    """
    own, (low, high) = starts_of(unknowns), bounds_of(unknowns)
    places = [own, *(np.clip(start, low, high) for start in starts or [])]
    looked = _looked(simulations, whitener, twin, unknowns, places, frames)
    best = min(looked, key=_cost, default=None)
    if best is None:
        return None
    theta, tracks, residual, cost = best
    last, slope, damping = jacobian, jacobian, 1e-3
    exact = slope is not None
    for number in range(iterations):
        if number >= _PATIENCE and cost > hopeless:
            break
        if slope is None:
            here = starting_at(unknowns, theta)
            slope, _ = sensitivities(simulations, whitener, twin, tracks, here, frames)
            last, exact = slope, True
        step = _step(unknowns, theta, residual, slope, damping, low, high)
        trials = [np.clip(theta + scale * step, low, high) for scale in _SCALES]
        looked = _looked(simulations, whitener, twin, unknowns, trials, frames)
        found = min(looked, key=_cost, default=None)
        if found is None or not found[3] < cost:
            if not exact:
                slope = None
            elif damping > 1.0:
                break
            else:
                damping *= 100.0
            continue
        gain, before, was = 1.0 - found[3] / cost, theta, residual
        theta, tracks, residual, cost = found
        damping = max(damping / 10.0, 1e-6)
        if gain < _TOLERANCE and exact:
            break
        last = _secant(slope, before, was, looked)
        slope, exact = (last, False) if gain >= _PAYS else (None, False)
    if not exact and (last is None or cost <= hopeless):
        here = starting_at(unknowns, theta)
        last, _ = sensitivities(simulations, whitener, twin, tracks, here, frames)
    assert last is not None
    final = starting_at(unknowns, theta)
    return Refit(final, at(twin, unknowns, theta), theta, tracks, residual, last)


def sensitivities(
    simulations: Simulations,
    whitener: Whitening,
    twin: Twin,
    base: Array,
    unknowns: list[Unknown],
    frames: int,
) -> tuple[Array, list[bool]]:
    """Whitened change of the prediction per unit of every unknown at its start, (M, p), and which runs failed.

    Args:
        base: tracks of the twin with every unknown at its start, (frames, N, 3).
    """
    steps = [unknown.probe for unknown in unknowns]
    start = starts_of(unknowns)
    jobs = []
    for k, step in enumerate(steps):
        probe = start.copy()
        probe[k] += step
        jobs.append(Job(at(twin, unknowns, probe), frames))
    found = simulations.run(jobs)
    rows = 3 * len(whitener.measured)
    columns = [
        np.zeros(rows) if tracks is None else whitener.change(tracks - base) / step
        for tracks, step in zip(found, steps, strict=True)
    ]
    failed = [tracks is None for tracks in found]
    return (np.stack(columns, axis=1) if columns else np.zeros((rows, 0))), failed


Found = tuple[Array, Array, Array, float]


def _cost(found: Found) -> float:
    return found[3]


def _looked(
    simulations: Simulations,
    whitener: Whitening,
    twin: Twin,
    unknowns: list[Unknown],
    places: list[Array],
    frames: int,
) -> list[Found]:
    """What the places (p,) give; those whose run cannot be trusted are left out."""
    runs = simulations.run([Job(at(twin, unknowns, place), frames) for place in places])
    found: list[Found] = []
    for place, tracks in zip(places, runs, strict=True):
        if tracks is not None:
            residual = whitener.residual(tracks)
            found.append((place, tracks, residual, float(residual @ residual) + _prior_cost(unknowns, place)))
    return found


def _secant(slope: Array, theta: Array, residual: Array, looked: list[Found]) -> Array:
    """Sensitivities (M, p) that agree with the runs of a line search from ``theta``, with the best one exactly.

    Steps are measured by what each unknown does, so that units do not count.
    """
    weight = np.maximum(np.sum(slope**2, axis=0), np.finfo(float).tiny)
    for place, _, there, _ in sorted(looked, key=_cost, reverse=True):
        step = place - theta
        size = float(step @ (weight * step))
        if size > 0.0:
            slope = slope + np.outer(residual - there - slope @ step, weight * step) / size
    return slope


def prior_rows(unknowns: list[Unknown], theta: Array) -> tuple[Array, Array]:
    """Priors as rows of a least-squares problem: (p,) residuals (mean minus theta over deviation), (p, p) slopes."""
    residual, slope = np.zeros(len(unknowns)), np.zeros((len(unknowns), len(unknowns)))
    for k, unknown in enumerate(unknowns):
        if unknown.prior is not None:
            mean, deviation = unknown.prior
            residual[k], slope[k, k] = (mean - theta[k]) / deviation, 1.0 / deviation
    return residual, slope


def _prior_cost(unknowns: list[Unknown], theta: Array) -> float:
    residual, _ = prior_rows(unknowns, theta)
    return float(residual @ residual)


def _step(
    unknowns: list[Unknown],
    theta: Array,
    residual: Array,
    slope: Array,
    damping: float,
    low: Array,
    high: Array,
) -> Array:
    """Damped Gauss-Newton step (p,); an unknown that a bound holds back stays there."""
    prior_residual, prior_slope = prior_rows(unknowns, theta)
    normal = slope.T @ slope + prior_slope.T @ prior_slope
    gradient = slope.T @ residual + prior_slope.T @ prior_residual
    free = np.ones(len(theta), dtype=bool)
    step = np.zeros(len(theta))
    for _ in range(len(theta)):
        step[:] = 0.0
        inner = damped(normal[np.ix_(free, free)], damping)
        if free.any():
            step[free] = np.linalg.solve(inner, gradient[free])
        room = _BOUND * (high - low)
        stuck = free & (((theta >= high - room) & (step > 0)) | ((theta <= low + room) & (step < 0)))
        if not stuck.any():
            break
        free &= ~stuck
    return step
