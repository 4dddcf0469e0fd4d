"""Marginal likelihood of a linear Gaussian model under noise and a smooth discrepancy: what a check is tried against.

With J the sensitivities, r the residual, priors P on the unknowns, all whitened for the amplitude kappa of the
discrepancy,

    log p(r | kappa) = - |r|^2 / 2 + g^T N^-1 g / 2 - log|N P^-1| / 2 - log|Sigma| / 2        N = J^T J + P, g = J^T r
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.check.discrepancy import Discrepancy
from physworld.estimation.left_out import Linear, unbound
from physworld.estimation.refit import prior_rows

_LEVELS = 28  # amplitudes that are tried, beside none
_LEAST, _MOST = 0.05, 3e4  # of the noise
_WEAKEST = 1e-9  # of the normal matrix's diagonal: keeps it invertible where data say nothing of an unknown


def amplitudes(discrepancy: Discrepancy) -> Array:
    """Kappa [m] that are tried, (L,): none, and from a twentieth of the noise upwards."""
    return np.concatenate([[0.0], discrepancy.sigma * np.geomspace(_LEAST, _MOST, _LEVELS)])


def log_prior(discrepancy: Discrepancy, kappa: Array) -> Array:
    """Logarithm of the density of kappa over the noise, up to a constant: half a Cauchy, which prefers zero."""
    density: Array = -np.log1p((np.asarray(kappa) / discrepancy.sigma) ** 2)
    return density


def marginal(linear: Linear, discrepancy: Discrepancy) -> tuple[float, float]:
    """Log marginal likelihood with kappa integrated out, and the most probable kappa [m]."""
    jacobian, residual = linear.jacobian, linear.residual
    prior_residual, prior_slope = prior_rows(linear.unknowns, linear.theta)
    precision = prior_slope.T @ prior_slope
    free = unbound(linear)
    inner = [
        (block.basis.T @ residual[block.rows], block.basis.T @ jacobian[block.rows])
        for block in discrepancy.blocks
    ]
    normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
    square = float(residual @ residual)
    spread = np.log([max(u.bounds[1] - u.bounds[0], 1e-300) for u in linear.unknowns])
    kappas = amplitudes(discrepancy)
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
        log_known = np.where(
            known > 0, np.log(np.maximum(known, 1e-300)), -spread[free] + 0.5 * np.log(2 * np.pi)
        )
        occam = 0.5 * np.linalg.slogdet(n)[1] - float(np.sum(log_known)) if len(g) else 0.0
        found[k] = -0.5 * fitted - occam - half
    found = found + log_prior(discrepancy, kappas)
    weights = np.concatenate([[amplitudes(discrepancy)[1]], np.gradient(kappas[1:])])
    total = found + np.log(weights / weights.sum())
    best = int(np.argmax(found))
    top = float(total.max())
    return top + float(np.log(np.exp(total - top).sum())), float(kappas[best])
