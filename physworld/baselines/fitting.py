"""Levenberg-Marquardt over logarithms and angles, for models that simulate many candidates side by side.

A column of the Jacobian is a candidate, and so is a step under each of a few dampings: an iteration is two runs.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from physworld.arrays import Array
from physworld.errors import CalibrationError

_DIFFERENCE = 1e-3
_DAMPINGS = (1e-5, 1e-3, 1e-2, 1e-1, 1e0, 1e2)
_LONGEST = 1.0  # of a step, in its largest number: a factor e, or a radian
_ENOUGH = 1e-4  # of the cost; a step that removes less is the last

Residuals = Callable[[Array], Array]
"""Candidates (B, p) to residuals (B, r); not finite where a candidate cannot be simulated."""


def least_squares(
    residuals: Residuals, starts: Array, lower: Array, upper: Array, iterations: int = 15
) -> Array:
    """The candidate (p,) of least squared residuals, from the best of ``starts`` (S, p) within the bounds.

    Args:
        residuals: of candidates (S, p) to (S, m); not finite where one could not be simulated.
        starts: candidates (S, p).
        lower: bounds (p,).
        upper: likewise.
        iterations: at most.

    Raises:
        CalibrationError: no start could be simulated.
    """
    first = residuals(starts)
    costs = _cost(first)
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        raise CalibrationError(f"none of {len(starts)} starts could be simulated")
    theta: Array = starts[best].copy()
    cost = costs[best]
    for _ in range(iterations):
        sign = np.where(theta + _DIFFERENCE > upper, -1.0, 1.0)
        found = residuals(np.concatenate([theta[None], theta + np.diag(sign * _DIFFERENCE)]))
        if not np.isfinite(found).all():
            break
        jacobian = (found[1:] - found[0]).T / (sign * _DIFFERENCE)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ found[0]
        scale = np.diag(normal) + 1e-12 * max(float(np.trace(normal)), 1e-30)
        steps = np.stack([np.linalg.solve(normal + np.diag(d * scale), -gradient) for d in _DAMPINGS])
        steps *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(steps).max(axis=1), 1e-30))[:, None]
        tried = np.clip(theta + steps, lower, upper)
        costs = _cost(residuals(tried))
        best = int(np.argmin(costs))
        if not costs[best] < cost:
            break
        removed = (cost - costs[best]) / cost
        theta, cost = tried[best], costs[best]
        if removed < _ENOUGH:
            break
    return theta


def _cost(residuals: Array) -> Array:
    with np.errstate(over="ignore", invalid="ignore"):
        cost = np.sum(residuals**2, axis=1)
    known: Array = np.where(np.isfinite(cost), cost, np.inf)
    return known
