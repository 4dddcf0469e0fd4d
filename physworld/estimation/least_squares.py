"""Damped Gauss-Newton over a few parameters with finite differences, and intervals that respect correlation.

Residuals of neighbouring frames and of one tracked point are not independent, so the usual s^2 (J^T J)^-1 is far too
small on real data. Scores are summed over clusters first (a sandwich: White 1980, Liang and Zeger 1986), over blocks
of consecutive frames and, where there are enough, over tracked points too (two ways: Cameron, Gelbach, Miller 2011).
With few clusters a sandwich may come out too small by chance; the variances are never below the usual ones.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from physworld.arrays import Array

_TOLERANCE = 2e-4  # relative fall of the cost that ends the search
_MAX_STEP = 1.5  # in the logarithm
_TRIALS = 5  # steps, each more damped than the last, before a search ends
_BLOCKS = 10
_FEWEST_POINTS = 10  # fewer tracked points than this are no clusters of their own


@dataclass(frozen=True)
class Solution:
    """Optimum in the scale of the search.

    Attributes:
        theta: (p,).
        cost: mean squared residual.
        residual: (m,).
        jacobian: (m, p).
    """

    theta: Array
    cost: float
    residual: Array
    jacobian: Array


Asked = tuple[list[Array], list[Array]]
"""Places whose residuals are needed now, and those that will be needed next if nothing speaks against them."""

Descent = Generator[Asked, list[np.ndarray], Solution]


def descent(theta: Array, low: Array, high: Array, steps: Array, max_iterations: int = 6) -> Descent:
    """Minimise the mean square of a residual from ``theta`` within [low, high], for whoever runs the simulations.

    Yields places that do not depend on each other and those that it will likely ask for next, is sent the residuals of
    the former, in their order, and returns the solution.

    A residual that is not finite is a failed simulation: the step is shortened; at the start it is what is returned.
    One run per parameter and Jacobian, one per trial step; ``max_iterations`` Jacobians at most.

    Args:
        theta: start, (p,).
        low, high: bounds, (p,) each.
        steps: of the finite differences, (p,).
        max_iterations: Jacobians at most.
    """
    theta = np.clip(theta, low, high)
    (now,) = yield [theta], probes_of(theta, high, steps)
    cost = float(np.mean(now**2))
    damping = 1e-3
    jacobian = np.zeros((len(now), len(theta)))
    for left in reversed(range(max_iterations if np.isfinite(cost) else 0)):
        probes = probes_of(theta, high, steps)
        jacobian = differences(theta, now, steps, probes, (yield probes, []))
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ now
        improved = False
        trial = _trial(theta, normal, gradient, damping, low, high)
        for tried in range(_TRIALS):
            harder = max(damping, 1e-4) * 8
            shorter = _trial(theta, normal, gradient, harder, low, high)
            likely = [shorter] if tried else probes_of(trial, high, steps) if left else []
            (trial_residual,) = yield [trial], likely
            trial_cost = float(np.mean(trial_residual**2))
            if np.isfinite(trial_cost) and trial_cost < cost:
                improved = True
                break
            trial, damping = shorter, harder
        if not improved:
            break
        gain = (cost - trial_cost) / cost
        theta, now, cost, damping = trial, trial_residual, trial_cost, damping / 5
        if gain < _TOLERANCE:
            break
    return Solution(theta, cost, now, jacobian)


def _trial(
    theta: Array,
    normal: Array,
    gradient: Array,
    damping: float,
    low: Array,
    high: Array,
) -> Array:
    """Where a damped step from ``theta`` (p,) leads."""
    step = np.clip(np.linalg.solve(damped(normal, damping), -gradient), -_MAX_STEP, _MAX_STEP)
    there: Array = np.clip(theta + step, low, high)
    return there


def damped_step(normal: Array, gradient: Array, damping: float, longest: float | Array) -> Array:
    """A step (p,) of a search whose priors make its normal matrix (p, p) invertible, damped as Marquardt does.

    Args:
        normal: half the second derivatives of the cost, (p, p).
        gradient: half the first ones, (p,).
        damping: share by which the diagonal is larger.
        longest: of the step, for all or each of the unknowns.
    """
    step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
    shortened: Array = np.clip(step, -longest, longest)
    return shortened


def damped(normal: Array, damping: float) -> Array:
    """A normal matrix (p, p) whose diagonal is larger by this share (Levenberg and Marquardt)."""
    return normal + damping * np.diag(np.diag(normal) + 1e-12 * np.trace(normal) + 1e-30)


def most_runs(parameters: int, max_iterations: int) -> int:
    """Runs that a descent takes at most."""
    return 1 + max_iterations * (parameters + _TRIALS)


def probes_of(theta: Array, high: Array, steps: Array) -> list[Array]:
    """Places beside ``theta`` (p,) that finite differences need, one a parameter, below it at its upper bound."""
    found = []
    for k in range(len(theta)):
        probe = theta.copy()
        probe[k] += -steps[k] if theta[k] + steps[k] > high[k] else steps[k]
        found.append(probe)
    return found


def differences(
    theta: Array,
    now: Array,
    steps: Array,
    probes: list[Array],
    residuals: list[Array],
) -> Array:
    """Jacobian (m, p) at ``theta``, whose residual is ``now``; a column that blew up is zero.

    Args:
        theta: (p,).
        now: residual there, (m,).
        steps: of the finite differences, (p,).
        probes: places of :func:`probes_of`, (p,) each.
        residuals: there, (m,) each.
    """
    jacobian = np.zeros((len(now), len(theta)))
    for k, (probe, there) in enumerate(zip(probes, residuals, strict=True)):
        jacobian[:, k] = np.sign(probe[k] - theta[k]) * (there - now) / steps[k]
    return np.nan_to_num(jacobian, nan=0.0, posinf=0.0, neginf=0.0)


def block_covariance(
    solution: Solution, frame_of_residual: Array, point_of_residual: Array | None = None
) -> Array:
    """Covariance of theta, (p, p): the correlations of the sensitivities, with the variances that clusters show.

    Args:
        solution: residual and Jacobian at the optimum.
        frame_of_residual: frame of every residual, (m,).
        point_of_residual: tracked point of every residual, (m,), or None.
    """
    jacobian, residual = solution.jacobian, solution.residual
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    scores = jacobian * residual[:, None]
    frames, frame_place = np.unique(frame_of_residual, return_inverse=True)
    edges = np.array_split(np.arange(len(frames)), min(_BLOCKS, len(frames)))
    block_of_frame = np.repeat(np.arange(len(edges)), [len(edge) for edge in edges])
    block = block_of_frame[frame_place]
    by_block = _sandwich(inverse, scores, block, len(solution.theta))
    freedom = max(len(residual) - len(solution.theta), 1)
    usual = inverse * float(residual @ residual) / freedom
    variance = np.maximum(np.diag(by_block), np.diag(usual))
    if point_of_residual is not None:
        points, point = np.unique(point_of_residual, return_inverse=True)
        if len(points) >= _FEWEST_POINTS:
            by_point = _sandwich(inverse, scores, point, len(solution.theta))
            by_both = _sandwich(inverse, scores, block * len(points) + point, len(solution.theta))
            variance = np.maximum(variance, np.diag(by_block + by_point - by_both))
    return _rescaled(usual, variance)


def correlations(covariance: Array) -> Array:
    """Correlation matrix (p, p); zero beside a parameter without variance."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    outer = np.outer(scale, scale)
    matrix = np.divide(covariance, outer, out=np.zeros_like(covariance), where=outer > 0)
    np.fill_diagonal(matrix, 1.0)
    return np.clip(matrix, -1.0, 1.0)


def interval_factor(frames: int, parameters: int) -> float:
    """Student factor of a two-sided 95 % interval from blocks of ``frames``; infinite for too few of them."""
    blocks = min(_BLOCKS, frames)
    return float(student.ppf(0.975, blocks - 1)) if blocks > parameters else float("inf")


def _sandwich(inverse: Array, scores: Array, cluster: Array, parameters: int) -> Array:
    count = int(cluster.max()) + 1
    sums = np.zeros((count, scores.shape[1]))
    np.add.at(sums, cluster, scores)
    correction = count / max(count - parameters, 1)
    return correction * inverse @ (sums.T @ sums) @ inverse


def _rescaled(covariance: Array, variance: Array) -> Array:
    """The matrix with the same correlations and the given diagonal."""
    now = np.diag(covariance)
    factor = np.sqrt(np.divide(variance, now, out=np.zeros_like(variance), where=now > 0))
    return covariance * np.outer(factor, factor)
