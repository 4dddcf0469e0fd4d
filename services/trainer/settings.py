"""The wire's settings of a training as the library's."""

from __future__ import annotations

import os

from physworld.worldmodel.model import config as settings_of
from physworld_schemas.model import TrainingConfig


def translate(
    config: TrainingConfig,
) -> tuple[settings_of.WorldModelConfig, settings_of.TrainingConfig, settings_of.FineTuneConfig]:
    """The wire's settings as the library's; threads from ``PHYSWORLD_TRAINER_THREADS``, 1 without it."""
    interval = max(1, min(250, config.steps // 8))
    return (
        settings_of.WorldModelConfig(
            hidden=config.hidden,
            message_passing_steps=config.message_passing_steps,
            history=config.history,
            vertices=config.vertices,
            near_edges=config.near_edges,
        ),
        settings_of.TrainingConfig(
            steps=config.steps,
            batch_size=config.batch_size,
            look_ahead=config.look_ahead,
            learning_rate=config.learning_rate,
            validation_every=interval,
            patience=config.patience,
            prior=config.prior,
            frame=config.frame,
            start_share=config.start_share,
            checkpoint_every=interval,
            threads=int(os.environ.get("PHYSWORLD_TRAINER_THREADS", "1")),
            seed=config.seed,
        ),
        settings_of.FineTuneConfig(steps=config.fine_tune_steps),
    )
