"""Marginal likelihood and left-out prediction of a fitted hypothesis under noise and discrepancy.

Linear in the unknowns about the optimum and Gaussian, so that everything is closed: with J the sensitivities, r the
residual, priors P on the unknowns, all whitened for the amplitude kappa of the discrepancy,

    log p(r | kappa) = - |r|^2 / 2 + g^T N^-1 g / 2 - log|N P^-1| / 2 - log|Sigma| / 2        N = J^T J + P, g = J^T r

(Laplace). The *left-out* density of a block of frames b is that of a Gaussian as well: the unknowns are refitted to the
other blocks, within their bounds, and predict b with their own uncertainty,

    r_b ~ N(J_b d_-b, I + J_b C_-b J_b^T).

The sum of its logarithms over blocks, a log pseudo-marginal likelihood (Geisser and Eddy 1979), asks what a model says
of frames that it has not seen, and charges for numbers that were only fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from physworld.arrays import Array
from physworld.estimation.refit import prior_rows
from physworld.estimation.unknowns import Unknown, bounds_of
from physworld.trace.discrepancy import Discrepancy

_WEAKEST = 1e-9  # of the normal matrix's diagonal: keeps it invertible where data say nothing of an unknown


@dataclass(frozen=True)
class Linear:
    """A hypothesis about its optimum, whitened by noise, places and solver, but not by a discrepancy.

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
class Evidence:
    """What the data say of a hypothesis.

    Attributes:
        kappa: most probable amplitude of the discrepancy [m].
        marginal: log of the likelihood with unknowns and kappa integrated out, up to a constant of the recording.
        left_out: log density of every block given the others, at that kappa, (B,).
        errors: squared residual of every block given the others over the number of its rows, (B,), without discrepancy.
        sizes: rows of every block, (B,).
    """

    kappa: float
    marginal: float
    left_out: Array
    errors: Array
    sizes: Array


def evidence(linear: Linear, discrepancy: Discrepancy) -> Evidence:
    """Marginal likelihood, amplitude of the discrepancy and left-out densities of a hypothesis."""
    marginals, kappa = marginal(linear, discrepancy)
    left_out, errors, sizes = _left_out(linear, discrepancy, kappa)
    return Evidence(kappa, marginals, left_out, errors, sizes)


def marginal(linear: Linear, discrepancy: Discrepancy) -> tuple[float, float]:
    """Log marginal likelihood with kappa integrated out, and the most probable kappa [m]."""
    jacobian, residual = linear.jacobian, linear.residual
    prior_residual, prior_slope = prior_rows(linear.unknowns, linear.theta)
    precision = prior_slope.T @ prior_slope
    free = _free(linear)
    inner = [
        (block.basis.T @ residual[block.rows], block.basis.T @ jacobian[block.rows])
        for block in discrepancy.blocks
    ]
    normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
    square = float(residual @ residual)
    spread = np.log([max(u.bounds[1] - u.bounds[0], 1e-300) for u in linear.unknowns])
    kappas = discrepancy.amplitudes()
    found = np.zeros(len(kappas))
    for k, kappa in enumerate(kappas):
        n, g, s, half = normal + precision, gradient + prior_slope.T @ prior_residual, square, 0.0
        for block, (r, j) in zip(discrepancy.blocks, inner, strict=True):
            variance = (kappa * block.factors) ** 2
            taken = variance / (1.0 + variance)
            n = n - (j.T * taken) @ j
            g = g - (j.T * taken) @ r
            s = s - float(r @ (taken * r))
            half += 0.5 * float(np.sum(np.log1p(variance)))
        n, g = n[np.ix_(free, free)], g[free]
        n = n + np.diag(_WEAKEST * np.diag(n) + 1e-30)
        fitted = (
            s + float(prior_residual @ prior_residual) - (float(g @ np.linalg.solve(n, g)) if len(g) else 0.0)
        )
        # an unknown without a prior is as likely anywhere within its bounds
        known = np.diag(prior_slope)[free]
        log_prior = np.where(
            known > 0, np.log(np.maximum(known, 1e-300)), -spread[free] + 0.5 * np.log(2 * np.pi)
        )
        occam = 0.5 * np.linalg.slogdet(n)[1] - float(np.sum(log_prior)) if len(g) else 0.0
        found[k] = -0.5 * fitted - occam - half
    found = found + discrepancy.log_prior(kappas)
    weights = np.concatenate([[discrepancy.amplitudes()[1]], np.gradient(kappas[1:])])
    total = found + np.log(weights / weights.sum())
    best = int(np.argmax(found))
    top = float(total.max())
    return top + float(np.log(np.exp(total - top).sum())), float(kappas[best])


def _free(linear: Linear) -> Array:
    """Unknowns that no bound holds, (p,)."""
    if not len(linear.unknowns):
        return np.zeros(0, dtype=bool)
    low, high = bounds_of(linear.unknowns)
    room = 1e-6 * (high - low)
    free: Array = (linear.theta > low + room) & (linear.theta < high - room)
    return free


def _left_out(linear: Linear, discrepancy: Discrepancy, kappa: float) -> tuple[Array, Array, Array]:
    residual = discrepancy.whitened(linear.residual, kappa)
    jacobian = discrepancy.whitened(linear.jacobian, kappa)
    prior_residual, prior_slope = prior_rows(linear.unknowns, linear.theta)
    normals = [jacobian[b.rows].T @ jacobian[b.rows] for b in discrepancy.blocks]
    gradients = [jacobian[b.rows].T @ residual[b.rows] for b in discrepancy.blocks]
    count = len(linear.unknowns)
    normal = sum(normals, np.zeros((count, count))) + prior_slope.T @ prior_slope
    gradient = sum(gradients, np.zeros(count)) + prior_slope.T @ prior_residual
    gradient[_free(linear)] = 0.0  # what a search has left of it is no fault of the block that is left out
    weakest = np.diag(_WEAKEST * np.diag(normal) + 1e-30)
    free, halves = _free(linear), discrepancy.log_determinants(kappa)
    densities, errors, sizes = [], [], []
    for k, block in enumerate(discrepancy.blocks):
        others = normal - normals[k] + weakest
        change = within_bounds(others, gradient - gradients[k], linear.unknowns, linear.theta)
        rows = block.rows
        left = residual[rows] - jacobian[rows] @ change
        square, occam = float(left @ left), 0.0
        if free.any():
            own, rest = normals[k][np.ix_(free, free)], others[np.ix_(free, free)]
            push = jacobian[rows][:, free].T @ left
            square -= float(push @ np.linalg.solve(rest + own, push))
            occam = 0.5 * (np.linalg.slogdet(rest + own)[1] - np.linalg.slogdet(rest)[1])
        densities.append(-0.5 * square - occam - float(halves[k]))
        plain = linear.residual[rows] - linear.jacobian[rows] @ change
        errors.append(float(np.mean(plain**2)))
        sizes.append(len(rows))
    return np.array(densities), np.array(errors), np.array(sizes)


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
