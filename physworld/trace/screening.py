"""What every effect promises beside a set of effects, to first order: one simulation a strength.

The score of a candidate is the share of the residual above the noise that goes with its sensitivities and those of the
calibrated parameters, within bounds and under priors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from physworld.arrays import Array
from physworld.estimation.refit import prior_rows
from physworld.estimation.unknowns import Unknown, bounds_of
from physworld.trace.candidates import Candidate
from physworld.trace.hypotheses import Hypothesis, Setting, Values
from physworld.trace.posterior import removes
from physworld.trace.sensitivity import Response, candidate_responses

_REACH = 0.3  # of its range: how far a linear estimate moves a calibrated number; a strength has all of it


@dataclass(frozen=True)
class Screened:
    """A candidate's first-order score against a hypothesis.

    Attributes:
        candidate: which.
        values: linear estimates of all unknowns, by name, in the scale of the search.
        share: of the root mean square residual above the noise that goes, to first order.
        error: mean squared residual over the noise's that stays.
    """

    candidate: Candidate
    values: Values
    share: float
    error: float


def screened(setting: Setting, base: Hypothesis, chosen: list[Candidate]) -> list[Screened]:
    """First-order scores of all candidates that ``base`` has not, best first."""
    others = [c for c in chosen if c.effect not in base.names]
    responses = candidate_responses(
        setting.simulations, base.white, base.fitted.twin, base.fitted.tracks, others, setting.frames
    )
    found = [_score(base, response) for response in responses if not response.failed]
    return sorted((one for one in found if one is not None), key=lambda one: -one.share)


def _score(base: Hypothesis, response: Response) -> Screened | None:
    candidate, columns = response.candidate, response.columns
    if not np.any(columns):
        return None
    gates = candidate.unknowns()
    freed = {gate.name for gate in gates}
    kept = [k for k, u in enumerate(base.fitted.unknowns) if u.name not in freed]
    known = [base.fitted.unknowns[k] for k in kept]
    start = np.concatenate([base.fitted.theta[kept], [base.values.get(g.name, 0.0) for g in gates]])
    unknowns = [u.starting(t) for u, t in zip([*known, *gates], start, strict=True)]
    jacobian = np.concatenate([base.fitted.jacobian[:, kept], columns], axis=1)
    change = _bounded(base, jacobian, unknowns, start, len(gates))
    error = float(np.mean((base.fitted.residual - jacobian @ change) ** 2))
    values = {u.name: float(t) for u, t in zip(unknowns, start + change, strict=True)}
    return Screened(candidate, values, removes(base.fitted.misfit**2, error), error)


def _bounded(
    base: Hypothesis, jacobian: Array, unknowns: list[Unknown], start: Array, strengths: int
) -> Array:
    """Linear change of all unknowns (p,) within their bounds, the last ones strengths, by what a sighting counts."""
    slope, residual = jacobian / base.unseen.scale, base.fitted.residual / base.unseen.scale
    prior_residual, prior_slope = prior_rows(unknowns, start)
    normal = slope.T @ slope + prior_slope.T @ prior_slope
    gradient = slope.T @ residual + prior_slope.T @ prior_residual
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    root = np.linalg.cholesky(normal * scale * scale[:, None] + 1e-9 * np.eye(len(scale)))
    low, high = bounds_of(unknowns)
    reach = np.where(np.arange(len(start)) < len(start) - strengths, _REACH, 1.0) * (high - low)
    low, high = np.maximum(low, start - reach), np.minimum(high, start + reach)
    bounds = np.minimum(low - start, 0.0) / scale, np.maximum(high - start, 1e-12) / scale
    target = np.linalg.solve(root, gradient * scale)
    change: Array = scale * lsq_linear(root.T, target, bounds, method="bvls").x
    return change
