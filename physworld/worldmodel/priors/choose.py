"""Which prior stands under the network: the modal one, or the chain where the body is a rope.

Every prior that can be made of the episodes is rolled out alone over whole held-out ones, the modal one in world axes
and in the grip's frame (``validation.priors_m`` of the card). Of the modal ones that which errs less is taken; a chain
and a modal one both go on as :func:`contenders`, until their networks show which is better. The frame is for turns of
the grips that validation episodes may not show: the modal prior in it is taken unless the one in world axes is clearly
better.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
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
from physworld.worldmodel.priors.prior_step import framed_prior, prior_step
from physworld.worldmodel.rollout import mean_error, unroll_tracks

MODAL, CHAIN, NONE, TURNED = "modal", "chain", "none", "modal_in_grip_frame"
CLEARLY = 0.95  # times the error in the grip's frame: what world axes must stay below to be taken
Prior = ModalPrior | ChainPrior | InertialPrior


def fit_priors(
    positions: list[Array],
    phis: list[Array],
    spec: GraphSpec,
    config: WorldModelConfig,
    wanted: str = "auto",
    frame: str = "auto",
) -> dict[str, Prior]:
    """Priors by name of vertex tracks (T, V, 3) and Φ (n, ·): the ``wanted`` one, or with "auto" all there are.

    A chain that is wanted where the body is no rope gives way to the modal prior. ``frame``: "world" or "grip" axes of
    the modal prior, or with "auto" both, where the graph has a grip's frame. The chain is in world axes.

    Args:
        positions: vertex tracks (T, V, 3) [m], object vertices first.
        phis: log property ratios of each (n, 2 or more).
        spec: the graph.
        config: history and number of modes.
        wanted: a prior's name, or "auto".
        frame: axes of the modal prior: "world", "grip", or "auto".
    """
    if wanted == NONE:
        return {NONE: InertialPrior(spec.object_count)}
    found: dict[str, Prior] = {}
    if wanted != MODAL:
        chain = fit_chain(positions, phis, spec, config.history)
        if chain is not None:
            found[CHAIN] = chain
    if wanted != CHAIN or not found:
        sizes = (spec.object_count, config.history, config.modes)
        framed = spec.frame is not None and frame != "world"
        if frame != "grip" or not framed:
            found[MODAL] = fit_prior(positions, phis, *sizes)
        if framed:
            found[TURNED] = fit_prior(positions, phis, *sizes, spec.frame)
    return found


def spec_for(name: str, spec: GraphSpec, frame: str = "auto") -> GraphSpec:
    """The graph for the prior ``name``: with its grip's frame, or without. The network alone has it but for "world"."""
    framed = name == TURNED or (name == NONE and frame != "world")
    return spec if framed else replace(spec, frame=None)


def choose(errors: dict[str, float]) -> str:
    """The prior with the least error; the modal one in the grip's frame also where that in world axes is not clearly
    better. One that leaves the numbers is taken only where all do."""
    known = {name: error if np.isfinite(error) else np.inf for name, error in errors.items()}
    best = min(known, key=known.__getitem__)
    if best == MODAL and known[MODAL] > CLEARLY * known.get(TURNED, np.inf):
        return TURNED
    return best


def contenders(errors: dict[str, float]) -> list[str]:
    """The priors whose networks compete: the chain and the modal one that errs less alone, where both keep to numbers;
    else the one that :func:`choose` takes."""
    modal = {name: error for name, error in errors.items() if name != CHAIN and np.isfinite(error)}
    if modal and np.isfinite(errors.get(CHAIN, np.inf)):
        return [CHAIN, choose(modal)]
    return [choose(errors)]


def prior_error(prior: Prior, tracks: list[Track], spec: GraphSpec, history: int) -> float:
    """Mean distance [m] of object vertices over whole episodes, predicted by the prior alone, in the graph's frame.

    Args:
        prior: without a network.
        tracks: whole episodes.
        spec: the graph.
        history: h.
    """
    alone = framed_prior(prior_step(prior, history), spec)

    def ahead(window: Tensor, control_next: Tensor, phi: Tensor) -> Tensor:
        return torch.cat([alone(window, control_next, phi), control_next])

    return mean_error(unroll_tracks(ahead, tracks, spec.object_count, history), tracks, spec)
