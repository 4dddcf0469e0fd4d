"""Damped Gauss-Newton over a few log-parameters with finite differences, and intervals that respect correlation.

Residuals of neighbouring frames and points are not independent, so the usual (J^T J)^-1 is far too small: scores are
summed over blocks of frames first (a cluster-robust sandwich, White 1980, Liang and Zeger 1986).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

Residual = Callable[[np.ndarray], np.ndarray]

_TOLERANCE = 2e-4  # relative fall of the cost that ends the search
_MAX_STEP = 1.5  # in the logarithm
_BLOCKS = 10


@dataclass(frozen=True)
class Solution:
    """Optimum in the logarithm of the parameters.

    Attributes:
        theta: (p,).
        cost: mean squared residual.
        residual: (m,).
        jacobian: (m, p).
    """

    theta: np.ndarray
    cost: float
    residual: np.ndarray
    jacobian: np.ndarray


def gauss_newton(
    residual: Residual,
    theta: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    steps: np.ndarray,
    max_iterations: int = 6,
) -> Solution:
    """Minimise |residual(theta)|^2 within bounds; a residual that is not finite counts as no descent.

    Args:
        residual: (p,) -> (m,).
        theta: start, (p,).
        low, high: bounds, (p,).
        steps: finite-difference steps, (p,).
        max_iterations: Jacobians at most.
    """
    theta = np.clip(theta, low, high)
    now = residual(theta)
    cost = float(np.mean(now**2))
    damping = 1e-3
    jacobian = np.zeros((len(now), len(theta)))
    for _ in range(max_iterations):
        for k in range(len(theta)):
            probe = theta.copy()
            sign = -1.0 if theta[k] + steps[k] > high[k] else 1.0
            probe[k] += sign * steps[k]
            jacobian[:, k] = sign * (residual(probe) - now) / steps[k]
        jacobian = np.nan_to_num(jacobian, nan=0.0, posinf=0.0, neginf=0.0)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ now
        improved = False
        for _ in range(5):
            scaled = normal + damping * np.diag(np.diag(normal) + 1e-12 * np.trace(normal) + 1e-30)
            step = np.clip(np.linalg.solve(scaled, -gradient), -_MAX_STEP, _MAX_STEP)
            trial = np.clip(theta + step, low, high)
            trial_residual = residual(trial)
            trial_cost = float(np.mean(trial_residual**2))
            if np.isfinite(trial_cost) and trial_cost < cost:
                improved = True
                break
            damping = max(damping, 1e-4) * 8
        if not improved:
            break
        gain = (cost - trial_cost) / cost
        theta, now, cost, damping = trial, trial_residual, trial_cost, damping / 5
        if gain < _TOLERANCE:
            break
    return Solution(theta, cost, now, jacobian)


def block_covariance(solution: Solution, frame_of_residual: np.ndarray) -> np.ndarray:
    """Covariance of theta, (p, p), with scores summed over blocks of consecutive frames."""
    jacobian, residual = solution.jacobian, solution.residual
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    frames = np.unique(frame_of_residual)
    edges = np.array_split(frames, min(_BLOCKS, len(frames)))
    meat = np.zeros_like(inverse)
    for block in edges:
        rows = (frame_of_residual >= block[0]) & (frame_of_residual <= block[-1])
        score = jacobian[rows].T @ residual[rows]
        meat += np.outer(score, score)
    blocks = len(edges)
    correction = blocks / max(blocks - len(solution.theta), 1)
    return correction * inverse @ meat @ inverse


def interval_factor(frames: int, parameters: int) -> float:
    """Student factor of a two-sided 95 % interval from blocks of ``frames``; infinite for too few of them."""
    blocks = min(_BLOCKS, frames)
    return float(student.ppf(0.975, blocks - 1)) if blocks > parameters else float("inf")
