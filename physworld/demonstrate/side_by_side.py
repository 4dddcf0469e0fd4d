"""Many episodes at once: the plans of many seeds, simulated side by side by the twin.

Each is what :func:`physworld.demonstrate.make_episode` makes of its seed, but for the time step, the smallest of those
that are simulated together: the same plan, the same checks, and where a plan is rejected the same next one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from physworld.arrays import Array
from physworld.demonstrate.config import DemonstrationConfig
from physworld.demonstrate.episode import (
    EpisodePlan,
    Progress,
    accepted_attributes,
    all_rejected,
    episode_arrays,
    plan_episode,
    regrasp_share_of,
    rejection,
    try_seed,
)
from physworld.errors import BatchRefused, SimulationError
from physworld.scene import Scene
from physworld.twin.batch import Episode, simulate_batch

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

Made = tuple[dict[str, Array], dict[str, Any]]


def make_episodes(
    scene: Scene,
    twin: Twin,
    config: DemonstrationConfig,
    seeds: Sequence[int],
    progress: Progress | None = None,
) -> list[Made | SimulationError]:
    """Arrays and attributes of an accepted episode for each seed, or the error of its last attempt.

    Args:
        scene: the recording whose limits the motions keep.
        twin: the object's.
        config: of the demonstrations.
        seeds: one an episode.
        progress: told (frames done, frames in all) of every batch, or None.

    Raises:
        BatchRefused: the twin cannot be simulated side by side, its effects differ from episode to episode, or grips
            let go.
    """
    if config.strengths:
        raise BatchRefused(f"{len(config.strengths)} strengths of effects that each episode draws for itself")
    if regrasp_share_of(twin, config) > 0.0 or twin.openings:
        raise BatchRefused("episodes in which grips let go are simulated one by one")
    made: list[Made | SimulationError | None] = [None] * len(seeds)
    rejected: list[list[dict[str, Any]]] = [[] for _ in seeds]
    waiting = list(range(len(seeds)))
    while waiting:
        plans: dict[int, EpisodePlan] = {}
        refused: dict[int, tuple[EpisodePlan | None, SimulationError]] = {}
        for place in waiting:
            try:
                plans[place] = plan_episode(scene, twin, config, try_seed(seeds[place], len(rejected[place])))
            except SimulationError as failure:
                refused[place] = None, failure
        for together in _starting_together(twin, plans):
            for place, result in _simulated(twin, {k: plans[k] for k in together}, progress).items():
                if isinstance(result, SimulationError):
                    refused[place] = plans[place], result
                else:
                    made[place] = result, accepted_attributes(plans[place], rejected[place])
        waiting = []
        for place, (plan, error) in sorted(refused.items()):
            tried = try_seed(seeds[place], len(rejected[place]))
            rejected[place].append(rejection(tried, plan, error))
            if len(rejected[place]) == config.attempts:
                made[place] = all_rejected(seeds[place], rejected[place])
            else:
                waiting.append(place)
    return [one for one in made if one is not None]


def _starting_together(twin: Twin, plans: dict[int, EpisodePlan]) -> list[list[int]]:
    """Plans that start at the same time: those from rest at once, a recording's own start at its release."""
    late = [k for k, plan in plans.items() if twin.release_s > 0.0 and not plan.from_rest]
    at_once = [k for k in plans if k not in late]
    return [places for places in (at_once, late) if places]


def _simulated(
    twin: Twin, plans: dict[int, EpisodePlan], progress: Progress | None
) -> dict[int, dict[str, Array] | SimulationError]:
    """Arrays of the plans, or why they cannot be trusted."""
    episodes = [
        Episode(
            plan.control_times,
            plan.control_points,
            plan.times,
            plan.properties,
            plan.drawn.parameters,
            plan.from_rest,
        )
        for plan in plans.values()
    ]
    results: dict[int, dict[str, Array] | SimulationError] = {}
    outcomes = simulate_batch(twin, episodes, progress=progress)
    for (place, plan), outcome in zip(plans.items(), outcomes, strict=True):
        try:
            results[place] = episode_arrays(plan, twin.particles_at(outcome.trusted()))
        except SimulationError as error:
            results[place] = error
    return results
