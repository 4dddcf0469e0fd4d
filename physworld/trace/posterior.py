"""Posterior of hypotheses: how often each would predict unseen blocks best, were the blocks drawn again.

Blocks of frames get Dirichlet weights (the Bayesian bootstrap), each hypothesis its weighted left-out error e, and with
n independent numbers (:mod:`physworld.estimation.left_out`) of a variance that nobody knows the log likelihood
-n/2 log e. The softmax of that and the log prior is averaged over the draws, as pseudo-BMA+ does it (Yao, Vehtari,
Simpson and Gelman 2018). So a hypothesis that wins in a few blocks only does not win by much, and the odds mean what
they say although no twin is the truth.

Prior: an effect acts with odds of one to one, whichever of the library it is, but for those whose file says otherwise;
so k effects of n have (2 n)^-k. Beside it stands the prior density of the strengths, over that at their mean.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from physworld.arrays import Array
from physworld.estimation.left_out import NOISE_KNOWN, LeftOut

MOST = 0.42  # share of the root mean square, two thirds of the square: what an effect removes to be named
_DRAWS = 4000


def posterior(known: Sequence[LeftOut], log_priors: Sequence[float], seed: int = 0) -> Array:
    """Weights of hypotheses, (H,), that add up to 1.

    Args:
        known: left-out errors of each, of the same blocks.
        log_priors: of each.
        seed: of the bootstrap.
    """
    sizes = known[0].sizes
    count = min(known, key=lambda one: one.mean).count
    drawn = np.random.default_rng(seed).dirichlet(np.ones(len(sizes)), size=_DRAWS) * sizes
    errors = drawn @ np.array([one.errors for one in known]).T / drawn.sum(axis=1, keepdims=True)
    total = -0.5 * count * np.log(errors) + np.asarray(log_priors)
    total -= total.max(axis=1, keepdims=True)
    weights = np.exp(total)
    found: Array = (weights / weights.sum(axis=1, keepdims=True)).mean(axis=0)
    return found


def removes(without: float, after: float) -> float:
    """Share of the root mean square error above the noise that goes; 0 where there is none beyond what is known of it.

    Args:
        without, after: mean squared errors of left-out blocks over the noise's, without and with an effect.
    """
    if without - 1.0 <= NOISE_KNOWN:
        return 0.0
    return 1.0 - float(np.sqrt(max(after - 1.0, 0.0) / (without - 1.0)))
