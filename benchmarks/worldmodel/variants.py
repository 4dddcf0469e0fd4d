"""What the study compares: ways to a world model, each given the same episodes and the same processor time.

A variant turns episodes into a predictor within a budget of processor seconds (fits of priors, scales and validations
counted). It is judged elsewhere (``benchmarks.worldmodel.study``), on episodes that it never sees.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch

from benchmarks.worldmodel.bodies import SUBTICKS, Episodes
from benchmarks.worldmodel.spectral import spectral
from physworld.worldmodel.dataset import Track
from physworld.worldmodel.model.config import TrainingConfig, WorldModelConfig
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.rollout import rollout_tracks
from physworld.worldmodel.training import train

MODEL = WorldModelConfig(hidden=64, message_passing_steps=7, vertices=80)
TRAINING = TrainingConfig(steps=240, checkpoint_every=10**9)
TIMED_STEPS = 40
SMALL = {"message_passing_steps": 3, "hidden": 48}
MOST_STEPS = 200_000

Predict = Callable[[list[Track]], list[torch.Tensor]]
"""Positions (T, V, 3) of episodes from their first frames, in the episodes' own ticks."""


@dataclass(frozen=True)
class Trained:
    """A predictor, the subticks between its ticks, how many frames it is given, and what its training said."""

    predict: Predict
    every: int
    given: int
    notes: dict[str, Any]


@dataclass(frozen=True)
class Variant:
    """A way to a world model.

    Attributes:
        label: for people.
        settings: of the training, what differs from the default.
        architecture: of the network, what differs from the default.
        every: subticks between the model's ticks.
        trains: false for a prior alone, which takes what it takes.
        mixes: whether the layers also mix along the graph's modes (``benchmarks.worldmodel.spectral``).
    """

    label: str
    settings: dict[str, Any]
    architecture: dict[str, Any]
    every: int = SUBTICKS
    trains: bool = True
    mixes: bool = False

    def learn(self, episodes: Episodes, budget_s: float, seed: int) -> Trained:
        """Train within ``budget_s`` processor seconds."""
        torch.set_num_threads(1)
        config = replace(MODEL, **self.architecture)
        spec = replace(episodes.spec, dt_s=episodes.spec.dt_s * self.every / SUBTICKS)
        tracks = episodes.tracks("taught", self.every)
        training = replace(TRAINING, seed=seed, **self.settings)
        network = spectral(tracks) if self.mixes else WorldModel
        if self.trains:
            steps = _affordable(tracks, spec, config, training, budget_s, network)
            training = replace(training, steps=steps, validation_every=max(1, steps // 10))
        else:
            training = replace(training, steps=0)
        begun = time.process_time()
        result = train(tracks, spec, config, training, network=network)
        notes = {
            "processor_s": time.process_time() - begun,
            "steps": result.steps,
            "best_step": result.best_step,
            "prior": result.prior,
            "validation_m": result.best_error_m,
            "validation_prior_m": result.prior_error_m,
            "curve": result.validation,
        }
        return Trained(
            lambda judged: rollout_tracks(result.model, judged), self.every, config.history + 1, notes
        )


def _affordable(
    tracks: list[Track],
    spec: GraphSpec,
    config: WorldModelConfig,
    training: TrainingConfig,
    budget_s: float,
    network: Callable[..., WorldModel],
) -> int:
    """Optimiser steps for the budget, from what a few of them and the start take; what is loaded once is not timed."""
    seconds = []
    for steps in (1, 0, TIMED_STEPS):
        begun = time.process_time()
        train(
            tracks, spec, config, replace(training, steps=steps, validation_every=MOST_STEPS), network=network
        )
        seconds.append(time.process_time() - begun)
    _, start, some = seconds
    a_step = (some - start) / TIMED_STEPS
    return int(max(10, min(MOST_STEPS, 0.9 * (budget_s - start) / max(a_step, 1e-4))))


VARIANTS = {
    "prior": Variant("prior alone, world axes", {"frame": "world"}, {}, trains=False),
    "today": Variant("prior and network, world axes (the default then)", {"frame": "world"}, {}),
    "network": Variant(
        "network alone, world axes", {"prior": "none", "frame": "world", "learning_rate": 3e-3}, {}
    ),
    "grip_prior": Variant("prior alone, grip's frame where it is chosen", {}, {}, trains=False),
    "grip": Variant("prior and network, grip's frame where it is chosen", {}, {}),
    "grip_network": Variant("network alone, grip's frame", {"prior": "none", "learning_rate": 3e-3}, {}),
    "fine_network": Variant(
        "network alone, grip's frame, 1/120 s, one-step training with noise",
        {
            "prior": "none",
            "look_ahead": 1,
            "batch_size": 32,
            "noise_history": 0.3,
            "learning_rate": 3e-3,
        },
        {"message_passing_steps": 5},
        every=2,
    ),
    "small_network": Variant(
        "network alone, grip's frame, 3 steps of width 48", {"prior": "none", "learning_rate": 3e-3}, SMALL
    ),
    "spectral_network": Variant(
        "network alone, grip's frame, 3 steps of width 48 that mix along modes",
        {"prior": "none", "learning_rate": 3e-3},
        SMALL,
        mixes=True,
    ),
    "small_grip": Variant(
        "prior and network, grip's frame where it is chosen, 3 steps of width 48", {}, SMALL
    ),
    "spectral_grip": Variant(
        "prior and network, grip's frame where it is chosen, 3 steps of width 48 that mix along modes",
        {},
        SMALL,
        mixes=True,
    ),
}
