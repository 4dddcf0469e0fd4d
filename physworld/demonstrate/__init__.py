"""Demonstrations: Bézier motions of the grips, part-aware property fields, episodes run by the twin."""

from physworld.demonstrate.episode import (
    DemonstrationConfig,
    EpisodePlan,
    derived_seed,
    make_episode,
    plan_episode,
    run_episode,
)

__all__ = [
    "DemonstrationConfig",
    "EpisodePlan",
    "derived_seed",
    "make_episode",
    "plan_episode",
    "run_episode",
]
