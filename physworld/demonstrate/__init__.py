"""Demonstrations: Bézier motions of the grips, part-aware property fields, episodes run by the twin."""

from physworld.demonstrate.config import DemonstrationConfig, StrengthRange
from physworld.demonstrate.episode import (
    EpisodePlan,
    derived_seed,
    make_episode,
    plan_episode,
    run_episode,
)

__all__ = [
    "DemonstrationConfig",
    "EpisodePlan",
    "StrengthRange",
    "derived_seed",
    "make_episode",
    "plan_episode",
    "run_episode",
]
