"""Posterior of hypotheses: how often each would predict unseen blocks best, were the blocks drawn again.

Weights are those of pseudo Bayesian model averaging with the Bayesian bootstrap (pseudo-BMA+: Yao, Vehtari, Simpson and
Gelman 2018): blocks of frames get Dirichlet weights, each hypothesis the weighted sum of its left-out log densities and
its prior, and the softmax of these is averaged. Blocks, and not sightings, are what is independent: so a hypothesis
that wins in a few blocks only does not win by much, and the odds mean what they say although no twin is the truth.

Prior: an effect acts with odds of one to one, whichever of the library it is; so k effects of n have (2 n)^-k.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from physworld.arrays import Array

_DRAWS = 4000


def posterior(left_out: Sequence[Array], effects: Sequence[int], library: int, seed: int = 0) -> Array:
    """Weights of hypotheses, (H,), that add up to 1.

    Args:
        left_out: log densities of the blocks given the others, (B,) for each hypothesis.
        effects: number of effects in each.
        library: number of effects that were asked.
        seed: of the bootstrap.
    """
    densities = np.array(left_out)
    blocks = densities.shape[1]
    prior = -np.asarray(effects) * np.log(2.0 * max(library, 1))
    drawn = np.random.default_rng(seed).dirichlet(np.ones(blocks), size=_DRAWS) * blocks
    total = drawn @ densities.T + prior
    total -= total.max(axis=1, keepdims=True)
    weights = np.exp(total)
    found: Array = (weights / weights.sum(axis=1, keepdims=True)).mean(axis=0)
    return found


HALF = 0.5
_NOISE_KNOWN = 0.05  # share to which the variance of the noise is known


def removes(without: float, after: float) -> float:
    """Share of the squared error above the noise that goes; 0 where there is none beyond what is known of the noise.

    Args:
        without, after: mean squared errors of left-out blocks over the noise's, without and with an effect.
    """
    if without - 1.0 <= _NOISE_KNOWN:
        return 0.0
    return 1.0 - max(after - 1.0, 0.0) / (without - 1.0)
