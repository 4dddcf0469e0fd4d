"""What a hypothesis says of frames that it has not seen, and for how much a sighting counts.

Linear in the unknowns about the optimum. A block of training frames is predicted by unknowns that are refitted to the
other blocks, within their bounds and under their priors; its *left-out error* is the mean squared whitened residual
that this leaves: 1 for a perfect model.

A twin's error beside the noise is the same for many sightings at once: where it was wrong in one frame it is wrong in
the next one too. Sightings are independent as far as noise goes, blocks of frames as far as that error goes. With a
left-out error e of which 1 is noise, M numbers in B blocks tell its mean as well as

    n(e) = 1 / ((1 / e)^2 / M + (1 - 1 / e)^2 / B)

independent numbers would (the variance of a mean square is the sum of its parts' variances). So everything that weighs
data against priors, or one hypothesis against another, counts n numbers instead of M: the likelihood is tempered
(Miller and Dunson 2019, "Robust Bayesian inference via coarsening"), by a number that the data give. Between
hypotheses it is n(e + 0.2), for that much error of the twin may hide in a noise whose variance is known to a fifth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from physworld.arrays import Array
from physworld.estimation.refit import prior_rows
from physworld.estimation.unknowns import Unknown, bounds_of

NOISE_KNOWN = 0.2  # share to which the variance of the noise is known: its deviation to a tenth
_WEAKEST = 1e-9  # of the normal matrix's diagonal: keeps it invertible where data say nothing of an unknown


@dataclass(frozen=True)
class Linear:
    """A hypothesis about its optimum, whitened by noise, places and solver.

    Attributes:
        residual: (M,).
        jacobian: (M, p).
        unknowns: p of them, starting at the optimum.
        theta: the optimum, (p,).
    """

    residual: Array
    jacobian: Array
    unknowns: list[Unknown]
    theta: Array


@dataclass(frozen=True)
class LeftOut:
    """Errors of every block given the others.

    Attributes:
        errors: mean squared whitened residuals, (B,).
        sizes: rows of every block, (B,).
    """

    errors: Array
    sizes: Array

    @property
    def mean(self) -> float:
        """Over all rows: 1 for a perfect model."""
        return float(np.average(self.errors, weights=self.sizes))

    @property
    def count(self) -> float:
        """Independent numbers that the rows are worth between hypotheses."""
        return independent(self.mean + NOISE_KNOWN, int(self.sizes.sum()), len(self.sizes))

    @property
    def scale(self) -> float:
        """Deviations of the noise that a sighting counts as."""
        return counted(self.mean, int(self.sizes.sum()), len(self.sizes))


def counted(error: float, rows: int, blocks: int) -> float:
    """Deviations of the noise that a sighting counts as, sqrt(e M / n); arguments of :func:`independent`."""
    return float(np.sqrt(max(error, 1.0) * rows / independent(max(error, 1.0), rows, blocks)))


def independent(error: float, rows: int, blocks: int) -> float:
    """n(e) of the module's text.

    Args:
        error: mean squared residual over the noise's.
        rows: numbers that were seen.
        blocks: of frames.
    """
    noise = min(1.0, 1.0 / error)
    return 1.0 / (noise**2 / rows + (1.0 - noise) ** 2 / blocks)


def left_out(linear: Linear, blocks: Sequence[Array], scale: float) -> LeftOut:
    """Errors of every block, predicted from the others.

    Args:
        linear: about its optimum.
        blocks: rows of every block of frames, B arrays.
        scale: deviations of the noise that a sighting counts as, for the weight of the priors.
    """
    residual, jacobian = linear.residual / scale, linear.jacobian / scale
    prior_residual, prior_slope = prior_rows(linear.unknowns, linear.theta)
    normals = [jacobian[rows].T @ jacobian[rows] for rows in blocks]
    gradients = [jacobian[rows].T @ residual[rows] for rows in blocks]
    count = len(linear.unknowns)
    normal = sum(normals, np.zeros((count, count))) + prior_slope.T @ prior_slope
    gradient = sum(gradients, np.zeros(count)) + prior_slope.T @ prior_residual
    gradient[unbound(linear)] = 0.0  # what a search has left of it is no fault of the block that is left out
    weakest = np.diag(_WEAKEST * np.diag(normal) + 1e-30)
    errors = []
    for k, rows in enumerate(blocks):
        others = normal - normals[k] + weakest
        change = within_bounds(others, gradient - gradients[k], linear.unknowns, linear.theta)
        errors.append(float(np.mean((linear.residual[rows] - linear.jacobian[rows] @ change) ** 2)))
    return LeftOut(np.array(errors), np.array([len(rows) for rows in blocks]))


def unbound(linear: Linear) -> Array:
    """Unknowns that no bound holds, (p,)."""
    if not len(linear.unknowns):
        return np.zeros(0, dtype=bool)
    low, high = bounds_of(linear.unknowns)
    room = 1e-6 * (high - low)
    free: Array = (linear.theta > low + room) & (linear.theta < high - room)
    return free


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
