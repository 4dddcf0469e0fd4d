"""Which of several refits predicts best, by blocks of training frames that it was not fitted to.

Leaving a block out moves the optimum little, so the refit without it is the linear one from the optimum's own
sensitivities, within the bounds of what was fitted; the block's error is measured with that. Differences between models
are taken block by block, so what all of them suffer from cancels, and their standard error is that of the blocks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from physworld.arrays import Array
from physworld.estimation.refit import Refit, prior_rows
from physworld.estimation.unknowns import Unknown, bounds_of

MEANINGFUL = 2.0  # standard errors by which a model must predict better than a simpler one
_RIDGE = 1e-9  # of the normal matrix's diagonal


@dataclass(frozen=True)
class CrossValidation:
    """Mean squared whitened error of every block, (B,), and the blocks' sizes, (B,)."""

    errors: Array
    sizes: Array

    @property
    def mean(self) -> float:
        """Over all rows."""
        return float(np.average(self.errors, weights=self.sizes))


def cross_validated(fitted: Refit, block_of_row: Array) -> CrossValidation:
    """Leave-one-block-out errors of a refit."""
    blocks = np.unique(block_of_row)
    normal, gradient = [], []
    for block in blocks:
        rows = block_of_row == block
        normal.append(fitted.jacobian[rows].T @ fitted.jacobian[rows])
        gradient.append(fitted.jacobian[rows].T @ fitted.residual[rows])
    prior_residual, prior_slope = prior_rows(fitted.unknowns, fitted.theta)
    all_normal = sum(normal) + prior_slope.T @ prior_slope
    all_gradient = sum(gradient) + prior_slope.T @ prior_residual
    errors, sizes = [], []
    for k, block in enumerate(blocks):
        rows = block_of_row == block
        ridge = _RIDGE * np.diag(np.diag(all_normal) + 1e-30)
        change = within_bounds(
            all_normal - normal[k] + ridge, all_gradient - gradient[k], fitted.unknowns, fitted.theta
        )
        left = fitted.residual[rows] - fitted.jacobian[rows] @ change
        errors.append(float(np.mean(left**2)))
        sizes.append(int(rows.sum()))
    return CrossValidation(np.array(errors), np.array(sizes))


def within_bounds(normal: Array, gradient: Array, unknowns: list[Unknown], theta: Array) -> Array:
    """The step (p,) that minimises d.normal.d / 2 - gradient.d and leaves no unknown outside its bounds.

    A step that is clipped afterwards leaves the others where they made up for what was cut off.

    Args:
        normal, gradient: (p, p) and (p,).
        unknowns, theta: p of them, and where they are in the scale of the search, (p,).
    """
    if not len(unknowns):
        return np.zeros(0)
    scale = 1.0 / np.sqrt(np.diag(normal))
    factor = np.linalg.cholesky(normal * scale * scale[:, None])
    low, high = (end - theta for end in bounds_of(unknowns))
    bounds = np.minimum(low, 0.0) / scale, np.maximum(high, 0.0) / scale
    target = solve_triangular(factor, gradient * scale, lower=True)
    step: Array = scale * lsq_linear(factor.T, target, bounds, method="bvls").x
    return step


def seen_through(residual: Array, basis: Array, block_of_row: Array) -> CrossValidation:
    """Mean squared error of every block once the directions ``basis`` (M, k), orthonormal, are taken out."""
    left = (residual - basis @ (basis.T @ residual)) ** 2
    sizes = np.bincount(block_of_row)
    there = sizes > 0
    return CrossValidation((np.bincount(block_of_row, left)[there] / sizes[there]), sizes[there])


def difference(worse: CrossValidation, better: CrossValidation) -> tuple[float, float]:
    """Mean of the blocks' differences of squared error, and its standard error."""
    gap = worse.errors - better.errors
    return _mean_with_error(gap, worse.sizes)


def better_beyond_chance(better: CrossValidation, worse: CrossValidation) -> bool:
    """Whether the blocks' errors are smaller, by more than two standard errors of the blocks.

    Blocks are compared by the logarithm of their ratio. An effect that grows over time, or acts while a grip is fast,
    explains little of some blocks and much of others: differences then vary as much as the effect does, and their
    standard error says that of the effect rather than of chance.
    """
    floor = np.finfo(float).tiny
    ratio = np.log(np.maximum(worse.errors, floor)) - np.log(np.maximum(better.errors, floor))
    gain, spread = _mean_with_error(ratio, worse.sizes)
    return gain > MEANINGFUL * spread and better.mean < worse.mean


def _mean_with_error(values: Array, sizes: Array) -> tuple[float, float]:
    """Mean of the blocks' values (B,) weighted with their sizes, and its standard error; infinite for one block."""
    weights = sizes / sizes.sum()
    mean = float(weights @ values)
    if len(values) < 2:
        return mean, float("inf")
    spread = float(np.sqrt(np.sum(weights**2 * (values - mean) ** 2) * len(values) / (len(values) - 1)))
    return mean, spread


def alikeness(first: Array, second: Array) -> float:
    """Absolute correlation of two explained residuals (M,)."""
    size = float(np.linalg.norm(first) * np.linalg.norm(second))
    return abs(float(first @ second)) / size if size > 0 else 0.0
