"""Efficient scores: the share of the residual that a candidate explains and the calibrated parameters cannot.

Residual and sensitivities come whitened. The calibrated parameters' sensitivities are projected out of both; the
candidate's strengths are fitted within their bounds; its score is the share R^2 of the squared residual that goes.

Residuals of neighbouring frames are not independent, so significance comes from the residual itself: the contribution
of every block of frames to the fit is given a random sign, the same for all candidates, and the best of all scores is
kept (a sign-flip score test, Hemerik, Goeman and Finos 2020, with the max statistic of Westfall and Young). An effect
that acts contributes with one sign all along; what matches by chance does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from physworld.arrays import Array
from physworld.estimation.unknowns import bounds_of
from physworld.trace.candidates import Candidate
from physworld.trace.sensitivity import Response


@dataclass(frozen=True)
class Score:
    """A candidate's score.

    Attributes:
        candidate: which.
        share: R^2, bounded fit.
        strengths: linear estimate in the units of its unknowns, (k,).
        direction: what it explains, (M,), after projection.
        p_value: of its score alone under random signs.
        absorbed: part of its squared sensitivity that the calibrated parameters can imitate.
        family: share that all variants of its effect explain together, which bounds what a shape between them can.
    """

    candidate: Candidate
    share: float
    strengths: Array
    direction: Array
    p_value: float
    family: float = 0.0
    absorbed: float = 0.0


@dataclass(frozen=True)
class Scores:
    """All scores, best first, with what chance would reach.

    Attributes:
        ranked: best first.
        threshold: family-wise quantile of the best score under random signs.
        decoys: scores of the decoys.
    """

    ranked: list[Score]
    threshold: float
    decoys: list[float]


def project(basis: Array, values: Array) -> Array:
    """``values`` (M,) or (M, k) less what the orthonormal ``basis`` (M, p) spans."""
    left: Array = values - basis @ (basis.T @ values)
    return left


def orthonormal(columns: Array) -> Array:
    """A basis of the columns' span, (M, r)."""
    if not columns.shape[1]:
        return columns
    size = np.linalg.norm(columns, axis=0)
    u, s, _ = np.linalg.svd(columns[:, size > 0] / size[size > 0], full_matrices=False)
    return u[:, s > 1e-8 * max(s.max(initial=0.0), 1e-30)]


def scores(
    residual: Array,
    calibrated: Array,
    responses: list[Response],
    decoys: list[Array],
    block_of_row: Array,
    level: float,
    resamples: int,
    seed: int,
) -> Scores:
    """Score every candidate.

    Args:
        residual: (M,), whitened.
        calibrated: sensitivities of what is estimated anyway, (M, p).
        responses: the candidates'.
        decoys: sensitivities that must not score, (M, 1) each.
        block_of_row: block of every row, (M,).
    """
    basis = orthonormal(calibrated)
    left = project(basis, residual)
    total = float(left @ left)
    rng = np.random.default_rng(seed)
    signs = rng.choice([-1.0, 1.0], size=(resamples, int(block_of_row.max()) + 1))
    best = np.zeros(resamples)
    ranked = []
    for response in responses:
        columns = project(basis, response.columns)
        gain, strengths = _bounded(columns, left, response.candidate)
        flipped = _flipped(columns, left, block_of_row, signs, response.candidate) / total
        best = np.maximum(best, flipped)
        share = gain / total
        p_value = float((1 + np.sum(flipped >= share)) / (1 + resamples))
        whole = float(np.sum(response.columns**2))
        absorbed = 1.0 - float(np.sum(columns**2)) / whole if whole > 0 else 0.0
        direction = columns @ strengths
        ranked.append(
            Score(response.candidate, share, strengths, direction, p_value, absorbed=max(absorbed, 0.0))
        )
    families = _families(responses, basis, left)
    ranked = [replace(s, family=max(s.share, families[s.candidate.effect] / total)) for s in ranked]
    ranked.sort(key=lambda s: -s.share)
    decoy_shares = [_explained(project(basis, column), left) / total for column in decoys]
    return Scores(ranked, float(np.quantile(best, 1.0 - level)), decoy_shares)


def _families(responses: list[Response], basis: Array, left: Array) -> dict[str, float]:
    """Squared residual that all variants with shapes of each effect explain together."""
    columns: dict[str, list[Array]] = {}
    for response in responses:
        shaped = [response.columns] if response.candidate.shapes else []
        columns.setdefault(response.candidate.effect, []).extend(shaped)
    return {
        effect: _explained(project(basis, np.concatenate(own, axis=1)), left) if own else 0.0
        for effect, own in columns.items()
    }


def _bounded(columns: Array, left: Array, candidate: Candidate) -> tuple[float, Array]:
    """Fall of the squared residual, and the strengths (k,), of the best fit within the bounds."""
    normal, product = columns.T @ columns, columns.T @ left
    if not np.any(normal):
        return 0.0, np.zeros(len(product))
    unknowns = candidate.unknowns()
    low, high = bounds_of(unknowns)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    root = np.linalg.cholesky(normal / np.outer(scale, scale) + 1e-9 * np.eye(len(scale)))
    target = np.linalg.solve(root, product / scale)
    if np.any(high - low <= 0):
        return 0.0, np.zeros(len(product))
    found = lsq_linear(root.T, target, bounds=(low * scale, high * scale)).x / scale
    return float(2 * product @ found - found @ normal @ found), found


def _explained(columns: Array, left: Array) -> float:
    normal, product = columns.T @ columns, columns.T @ left
    return float(product @ np.linalg.lstsq(normal, product, rcond=None)[0])


def _flipped(columns: Array, left: Array, block_of_row: Array, signs: Array, candidate: Candidate) -> Array:
    """Squared residual explained under every sign pattern, (R,); one-sided where a strength has one sign."""
    products = columns * left[:, None]
    by_block = np.zeros((signs.shape[1], columns.shape[1]))
    np.add.at(by_block, block_of_row, products)
    summed = signs @ by_block
    for k, unknown in enumerate(candidate.unknowns()):
        if len(candidate.gates) == 1 and unknown.low >= 0:
            summed[:, k] = np.maximum(summed[:, k], 0.0)
    inverse = np.linalg.pinv(columns.T @ columns)
    explained: Array = np.einsum("rk,kl,rl->r", summed, inverse, summed)
    return explained
