"""Which prior stands under the network: the modal one, or the chain where the body is a rope.

Every prior that can be made of the episodes is rolled out alone over whole held-out ones; the training takes the one
that errs least, and the card says what each erred (``validation.priors_m``).
"""

from __future__ import annotations

import torch
from torch import Tensor

from physworld.arrays import Array
from physworld.worldmodel.dataset import Track
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.inertia import InertialPrior
from physworld.worldmodel.priors.chain import ChainPrior
from physworld.worldmodel.priors.chain_fit import fit_chain
from physworld.worldmodel.priors.modal import ModalPrior, fit_prior
from physworld.worldmodel.priors.prior_step import prior_step
from physworld.worldmodel.rollout import mean_error, unroll_tracks

MODAL, CHAIN, NONE = "modal", "chain", "none"
Prior = ModalPrior | ChainPrior | InertialPrior


def fit_priors(
    positions: list[Array],
    phis: list[Array],
    spec: GraphSpec,
    config: WorldModelConfig,
    wanted: str = "auto",
) -> dict[str, Prior]:
    """Priors by name of vertex tracks (T, V, 3) and Φ (n, ·): the ``wanted`` one, or with "auto" all there are.

    A chain that is wanted where the body is no rope gives way to the modal prior.
    """
    if wanted == NONE:
        return {NONE: InertialPrior(spec.object_count)}
    found: dict[str, Prior] = {}
    if wanted != MODAL:
        chain = fit_chain(positions, phis, spec, config.history)
        if chain is not None:
            found[CHAIN] = chain
    if wanted != CHAIN or not found:
        found[MODAL] = fit_prior(positions, phis, spec.object_count, config.history, config.modes)
    return found


def prior_error(prior: Prior, tracks: list[Track], spec: GraphSpec, history: int) -> float:
    """Mean distance [m] of object vertices over whole episodes, predicted by the prior alone."""
    step = prior_step(prior, history)

    def ahead(window: Tensor, control_next: Tensor, phi: Tensor) -> Tensor:
        return torch.cat([step(window, control_next, phi), control_next])

    return mean_error(unroll_tracks(ahead, tracks, spec.object_count, history), tracks, spec)
