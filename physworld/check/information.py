"""What sensitivities say of parameters and effects before anything is fitted: Fisher's information, to first order.

With J the whitened sensitivities of the calibrated numbers, each in deviations of its prior, the posterior covariance
of these is (J^T J + I)^-1, whatever will be measured. A of an effect's gates, each in its plausible size, are what its
gates do; what re-tuning cannot imitate of them is

    F = A^T A - A^T J (J^T J + I)^-1 J^T A.

An effect of strengths s (in plausible sizes) raises the logarithm of its posterior odds to

    q / 2 - log det(I + F) / 2 - log(2 n)        q = u^T (F + I)^-1 u,  u ~ N(F s, F)

(its Bayes factor with the plausible sizes as deviations of its prior, and the prior odds of one effect among n that a
trace has). It is *detected* where these odds reach those of a posterior of 95 %. The strength that is detected in 95 %
of all recordings follows from the distribution of q, a noncentral chi-square (exact for one gate whose F is large).

A trace also asks that an effect takes half of the squared error above the noise that is there without it. So under an
assumed discrepancy of the model its doing must be no smaller than that one's, both as the noise alone whitens them.

Of two effects a and b, the part of a's doing that b imitates best is a correlation; what is left of it decides from
which strength on a recording of a is not one of b any more (the likelihoods differ by more than 19, in 95 %).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chndtrinc
from scipy.stats import norm

from physworld.arrays import Array
from physworld.check.discrepancy import Discrepancy

POSTERIOR = 0.95  # from which a trace names
POWER = 0.95  # of all recordings in which that must happen
_FEWEST = 1e-6  # of a direction's largest information: what is less is rounding
_LEAST_FREEDOM = 1e-3  # of a chi-square that is not degenerate
_ODDS = float(np.log(POSTERIOR / (1.0 - POSTERIOR)))
_Z = float(norm.ppf(POWER))


@dataclass(frozen=True)
class Information:
    """J^T J of columns that are scaled by their priors; recordings add up.

    Attributes:
        matrix: of columns that noise and discrepancy whiten, (q, q).
        plain: of columns that noise alone whitens, (q, q).
        error: squared discrepancy that is expected, whitened by the noise alone.
        library: n, effects that a trace asks.
    """

    matrix: Array
    plain: Array
    error: float
    library: int

    @classmethod
    def of(cls, columns: Array, discrepancy: Discrepancy, kappa: float, library: int) -> Information:
        """Of one recording.

        Args:
            columns: sensitivities that noise and places whiten, (M, q), one a number, per deviation of its prior.
            discrepancy: of the model.
            kappa: its deviation per axis [m].
            library: effects that a trace asks.
        """
        whitened = discrepancy.whitened(columns, kappa)
        error = kappa**2 * sum(float(np.sum(block.factors**2)) for block in discrepancy.blocks)
        return cls(whitened.T @ whitened, columns.T @ columns, error, library)

    def __add__(self, other: Information) -> Information:
        """Of both recordings, if they share every number."""
        return Information(
            self.matrix + other.matrix, self.plain + other.plain, self.error + other.error, self.library
        )

    def deviations(self, numbers: Array) -> Array:
        """Posterior deviations of these columns over those of their priors, (p,), all of them calibrated together."""
        found: Array = np.sqrt(np.diag(np.linalg.inv(_with_priors(self.matrix, numbers))))
        return found

    def beyond(self, gates: Array, calibrated: Array) -> Array:
        """F, (k, k): what these columns do that the calibrated ones cannot imitate.

        Args:
            gates: columns (k,).
            calibrated: columns (p,).
        """
        return _beyond(self.matrix, gates, calibrated)

    def detectable(self, gates: Array, calibrated: Array) -> tuple[float, Array]:
        """The multiple of a plausible effect that is detected, and of every gate alone (k,); infinite for none."""
        values, vectors = np.linalg.eigh(self.beyond(gates, calibrated))
        values = np.maximum(values, 0.0)
        weights = values / (1.0 + values)
        if not np.any(values > 0):
            return np.inf, np.full(len(gates), np.inf)
        needed = 2.0 * (_ODDS + np.log(2.0 * self.library)) + float(np.sum(np.log1p(values)))
        reached = noncentrality(needed, max(float(weights.sum()), _LEAST_FREEDOM))
        typical = float(np.sum(weights * values))
        alone = vectors**2 @ (weights * values)
        doing = np.diag(_beyond(self.plain, gates, calibrated))
        with np.errstate(divide="ignore"):
            multiple = float(np.sqrt(max(reached / typical, self.error / float(doing.sum()))))
            return multiple, np.sqrt(np.maximum(reached / alone, self.error / doing))

    def apart(self, gates: Array, others: Array, calibrated: Array) -> tuple[float, float]:
        """How alike an effect looks to another one, and the multiple of its plausible size from which it does not.

        Args:
            gates: columns of the effect that acts, (k,).
            others: columns of the one that it could be taken for, (m,).
            calibrated: columns (p,).
        """
        both = self.beyond(np.concatenate([gates, others]), calibrated)
        k = len(gates)
        own, cross, other = both[:k, :k], both[:k, k:], both[k:, k:]
        whole = float(np.trace(own))
        if whole <= 0.0:
            return 0.0, np.inf
        explained = np.trace(cross @ np.linalg.pinv(other, rcond=_FEWEST, hermitian=True) @ cross.T)
        imitated = float(np.clip(explained / whole, 0.0, 1.0))
        left = whole * (1.0 - imitated)
        distance = _Z + np.sqrt(_Z**2 + 2.0 * _ODDS)
        return float(np.sqrt(imitated)), float(distance / np.sqrt(left)) if left > 0 else np.inf


def _beyond(matrix: Array, gates: Array, calibrated: Array) -> Array:
    own: Array = matrix[np.ix_(gates, gates)]
    if not len(calibrated):
        return own
    cross = matrix[np.ix_(calibrated, gates)]
    left: Array = own - cross.T @ np.linalg.solve(_with_priors(matrix, calibrated), cross)
    return left


def _with_priors(matrix: Array, numbers: Array) -> Array:
    known: Array = matrix[np.ix_(numbers, numbers)] + np.eye(len(numbers))
    return known


def noncentrality(needed: float, freedom: float) -> float:
    """The noncentrality with which a chi-square of this many degrees of freedom exceeds ``needed`` in ``POWER``."""
    return float(chndtrinc(needed, freedom, 1.0 - POWER))
