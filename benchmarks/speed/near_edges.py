"""``python -m benchmarks.speed.near_edges --json FILE``: material or current NEAR edges, a prior or none.

Small world models that differ in ``near_edges`` and ``prior``, of two bodies: the sample's beam (its twin's
demonstrations), and a hairpin whose arms touch (``benchmarks.peers.hairpin``). Without a prior they get five times the
optimiser steps, since all of the motion is theirs to learn. The error is that of whole episodes that no training saw,
open loop from their first frames, against what taught them.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.harness import Report, run_alone
from benchmarks.paper.models import SMALL, TRAINING, WITHOUT_PRIOR, case_of, demonstrations
from benchmarks.peers import hairpin
from physworld.demonstrate import DemonstrationConfig
from physworld.worldmodel.dataset import read_track
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.graph import GraphSpec, build_graph
from physworld.worldmodel.training import train
from physworld.worldmodel.training_run import open_loop_error

BEAM, HAIRPIN = "soft_beam", "hairpin"
EPISODES, UNSEEN, SEEDS = {BEAM: 32, HAIRPIN: 24}, 12, 2
SETTINGS = {"auto": TRAINING, "none": WITHOUT_PRIOR}
CASES = [(BEAM, prior, edges) for prior in SETTINGS for edges in ("material", "current")] + [
    (HAIRPIN, "auto", edges) for edges in ("material", "current")
]
# Every mass a vertex; an edge reaches over the gap only where the arms are pressed together.
OF_HAIRPIN = replace(SMALL, vertices=1000, neighbours=14, edge_radius_spacings=2.0, coarse_vertices=8)

Graphs = Callable[[WorldModelConfig], GraphSpec]
Errors = dict[str, list[float]]


def measure(repeats: int, seed: int) -> Report:
    """Every case at ``SEEDS`` seeds; ``repeats`` is not used."""
    del repeats
    torch.set_num_threads(1)
    touching = [hairpin.episode(index) for index in range(EPISODES[HAIRPIN] + UNSEEN)]
    made = {
        BEAM: (SMALL, *_beam(seed)),
        HAIRPIN: (OF_HAIRPIN, _hairpin_graph, [arrays for arrays, _ in touching]),
    }
    errors: Errors = {}
    for trial in range(seed, seed + SEEDS):
        for scene, prior, edges in CASES:
            config, graph, episodes = made[scene]
            config = replace(config, near_edges=edges)
            error = _unseen_error(config, graph(config), episodes, EPISODES[scene], prior, trial)
            errors.setdefault(f"{scene}.{prior}.{edges}", []).append(error)
            print(f"{scene} {prior} {edges} {trial}: {1e3 * error:.2f} mm", file=sys.stderr, flush=True)
    return report_of(errors, float(np.mean([share for _, share in touching])), seed)


def _unseen_error(
    config: WorldModelConfig,
    spec: GraphSpec,
    episodes: Sequence[dict[str, np.ndarray]],
    taught: int,
    prior: str,
    seed: int,
) -> float:
    """Open-loop error [m] on the episodes after the first ``taught``."""
    tracks = [read_track(spec, arrays, config.history) for arrays in episodes]
    trained = train(tracks[:taught], spec, config, replace(SETTINGS[prior], seed=seed))
    return open_loop_error(trained.model, tracks[taught:])


def _beam(seed: int) -> tuple[Graphs, list[dict[str, np.ndarray]]]:
    """Graph and demonstrations of the sample's twin."""
    with tempfile.TemporaryDirectory() as folder:
        case = case_of(BEAM, Path(folder))
    assert case is not None  # it is part of the repository
    twin = case.twin

    def graph(config: WorldModelConfig) -> GraphSpec:
        return build_graph(
            twin.particles_rest,
            twin.particles_start,
            twin.controllers_start,
            dt_s=case.view.spec.dt_s,
            config=config,
            control_groups=twin.controller_groups,
            ground_height_m=twin.ground_height_m,
        )

    return graph, demonstrations(case, DemonstrationConfig(), EPISODES[BEAM] + UNSEEN, seed)[0]


def _hairpin_graph(config: WorldModelConfig) -> GraphSpec:
    rest = hairpin.rest_places()
    low, high = hairpin.grips(rest)
    held = np.concatenate([low, high])
    groups = (np.arange(len(low)), len(low) + np.arange(len(high)))
    return build_graph(rest, rest, rest[held], dt_s=hairpin.DT_S, config=config, control_groups=groups)


def report_of(errors: Errors, touching: float, seed: int) -> Report:
    """The table of what every case erred [m]; ``touching``: share of the hairpin's frames with contact."""
    return Report(
        name="near_edges",
        title="Material or current neighbours, with a prior or without",
        figures={"unseen_m": errors, "touching_share": touching},
        header=["body", "under the network", "near edges", "steps", "unseen episodes [mm]", "each seed [mm]"],
        rows=[_row(scene, prior, edges, errors[f"{scene}.{prior}.{edges}"]) for scene, prior, edges in CASES],
        notes=[
            f"{EPISODES[BEAM]} demonstrations of the beam and {EPISODES[HAIRPIN]} of the hairpin to learn from, "
            f"{UNSEEN} unseen; mean distance of vertices over whole episodes, open loop; {SEEDS} seeds. Hidden "
            f"{SMALL.hidden}, {SMALL.message_passing_steps} message passing steps: smaller than the service's.",
            f"The beam does not touch itself; the hairpin's arms touch in {touching:.0%} of its frames.",
            "Without a prior the best average may be the first one, of vertices that keep their velocity: the "
            "largest error here.",
        ],
        seed=seed,
    )


def _row(scene: str, prior: str, edges: str, errors_m: list[float]) -> list[str]:
    errors = 1e3 * np.array(errors_m)
    return [
        scene,
        {"auto": "prior", "none": "nothing"}[prior],
        edges,
        str(SETTINGS[prior].steps),
        f"{errors.mean():.2f}",
        ", ".join(f"{error:.2f}" for error in errors),
    ]


if __name__ == "__main__":
    run_alone(measure)
