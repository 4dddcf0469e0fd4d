"""``python -m benchmarks.near_edges --json FILE``: material or current NEAR edges, a prior or none, on one scene.

The sample's beam: its twin, demonstrations of it, and small world models (``benchmarks.paper_models``) that differ in
``near_edges`` and ``prior``; without a prior they get five times the optimiser steps, since all of the motion is theirs
to learn. The error is that of whole episodes that no training saw, open loop from their first frames, against the twin.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.harness import Report, run_alone
from benchmarks.paper_models import SMALL, TRAINING, case_of, demonstrations
from physworld.demonstrate import DemonstrationConfig
from physworld.worldmodel.dataset import read_track
from physworld.worldmodel.graph import build_graph
from physworld.worldmodel.training import open_loop_error, train

SCENE = "soft_beam"
EPISODES, UNSEEN, SEEDS = 32, 12, 2
SETTINGS = {
    "auto": TRAINING,
    "none": replace(
        TRAINING, prior="none", steps=5 * TRAINING.steps, learning_rate=5e-3, validation_every=40
    ),
}
CASES = [(prior, edges) for prior in ("auto", "none") for edges in ("material", "current")]


def measure(repeats: int, seed: int) -> Report:
    """Every case at ``SEEDS`` seeds; ``repeats`` is not used."""
    del repeats
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        case = case_of(SCENE, Path(folder))
    assert case is not None  # it is part of the repository
    episodes, _ = demonstrations(case, DemonstrationConfig(), EPISODES + UNSEEN, seed)
    found: dict[str, dict[str, list[float]]] = {}
    for trial in range(seed, seed + SEEDS):
        for prior, edges in CASES:
            config = replace(SMALL, near_edges=edges)
            spec = build_graph(
                case.twin.particles_rest,
                case.twin.particles_start,
                case.twin.controllers_start,
                dt_s=case.view.spec.dt_s,
                config=config,
                control_groups=case.twin.controller_groups,
                ground_height_m=case.twin.ground_height_m,
            )
            tracks = [read_track(spec, arrays, config.history) for arrays in episodes]
            started = time.perf_counter()
            trained = train(tracks[:EPISODES], spec, config, replace(SETTINGS[prior], seed=trial))
            seconds = time.perf_counter() - started
            error = open_loop_error(trained.model, tracks[EPISODES:])
            own = found.setdefault(f"{prior}.{edges}", {"unseen_m": [], "training_s": []})
            own["unseen_m"].append(error)
            own["training_s"].append(seconds)
            print(
                f"{prior} {edges} {trial}: {1e3 * error:.2f} mm, {seconds:.0f} s", file=sys.stderr, flush=True
            )
    return report_of(found, seed)


def report_of(found: dict[str, dict[str, list[float]]], seed: int) -> Report:
    """The table of what every case erred."""
    return Report(
        name="near_edges",
        title="Material or current neighbours, with a prior or without",
        figures={"scene": SCENE, "cases": found},
        header=[
            "under the network",
            "near edges",
            "optimiser steps",
            "unseen episodes [mm]",
            "each seed [mm]",
        ],
        rows=[_row(prior, edges, found[f"{prior}.{edges}"]["unseen_m"]) for prior, edges in CASES],
        notes=[
            f"{SCENE}: {EPISODES} demonstrations to learn from, {UNSEEN} unseen; mean distance of vertices from the "
            f"twin over whole episodes, open loop; mean of {SEEDS} seeds. Hidden {SMALL.hidden}, "
            f"{SMALL.message_passing_steps} steps, {SMALL.vertices} vertices: smaller than the service's. The "
            "beam does not touch itself. Without a prior the best average may be the first one, of vertices that "
            "keep their velocity: the largest error here.",
        ],
        seed=seed,
    )


def _row(prior: str, edges: str, errors_m: list[float]) -> list[str]:
    errors = 1e3 * np.array(errors_m)
    return [
        {"auto": "prior", "none": "nothing"}[prior],
        edges,
        str(SETTINGS[prior].steps),
        f"{errors.mean():.2f}",
        ", ".join(f"{error:.2f}" for error in errors),
    ]


if __name__ == "__main__":
    run_alone(measure)
