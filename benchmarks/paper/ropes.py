"""``python -m benchmarks.paper.ropes --json FILE``: what stands under a rope's world model.

For real ropes and one of another engine: the modal prior and the chain, fitted to the same demonstrations of the
scene's twin. Two errors of each, without any network: open loop over whole episodes that neither saw, against the
twin, and on the recording's held-out frames, where the twin's own error stands beside. Scenes that are not on this
machine are left out. Minutes, most of them for the twins.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.harness import Report, run_alone
from benchmarks.paper.models import SHARED
from physworld.calibrate import CalibrationConfig, calibrate
from physworld.demonstrate import DemonstrationConfig, derived_seed, make_episode
from physworld.evaluate.table import held_out_table
from physworld.worldmodel.clock import resample_smooth
from physworld.worldmodel.dataset import read_track, split_tracks
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.priors.choose import fit_priors, prior_error
from physworld.worldmodel.rollout import rollout
from physworld.worldmodel.scene_view import view_scene
from physworld_scenes.bundle import read_bundle

SCENES = {
    "rope_a_ring (real recording)": SHARED / "real" / "rope_a_ring",
    "d10 (PyElastica, gravity tilted)": SHARED / "undeclared" / "d10",
}
EPISODES = 40
MODEL = WorldModelConfig()


def scene_row(path: Path, seed: int) -> dict[str, Any]:
    """Errors [m] of the priors on unseen episodes, and of priors and twin on the recording's held-out frames."""
    scene = read_bundle(path)
    twin = calibrate(scene, CalibrationConfig()).twin
    view = view_scene(scene, twin, MODEL)
    config = DemonstrationConfig()
    episodes = [make_episode(scene, twin, config, derived_seed(seed, index))[0] for index in range(EPISODES)]
    tracks = [read_track(view.spec, arrays, MODEL.history) for arrays in episodes]
    learn, judge = split_tracks(tracks, 0.25, seed)
    priors = fit_priors(
        [track.positions.numpy() for track in learn], [track.phi.numpy() for track in learn], view.spec, MODEL
    )
    times = scene.times - scene.times[0]
    paths = {"twin": resample_smooth(view.twin_tracks, view.times, times)}
    phi = np.zeros((view.spec.object_count, 2))
    for name, prior in priors.items():
        untrained = WorldModel(MODEL, view.spec, None, prior)
        rolled = rollout(untrained, view.spec, view.start_history, view.controllers[view.first :], phi)
        paths[name] = view.tracks_of(rolled)
    finite = {name: path for name, path in paths.items() if np.isfinite(path).all()}
    return {
        "episodes_m": {
            name: prior_error(prior, judge, view.spec, MODEL.history) for name, prior in priors.items()
        },
        "recording_m": held_out_table(scene, finite)["track_m"],
    }


def measure(repeats: int, seed: int) -> Report:
    """Every scene that is here; ``repeats`` is not used: fits and rollouts are deterministic."""
    del repeats
    torch.set_num_threads(1)
    figures: dict[str, Any] = {}
    for name, path in SCENES.items():
        if path.is_dir():
            figures[name] = scene_row(path, seed)
            print(f"{name}: {figures[name]['episodes_m']}", file=sys.stderr, flush=True)
        else:
            print(f"{name}: left out, {path} is not on this machine", file=sys.stderr)
    rows = []
    for name, found in figures.items():
        own, seen = found["episodes_m"], found["recording_m"]
        shown = [own.get("modal"), own.get("chain"), *(seen.get(key) for key in ("modal", "chain", "twin"))]
        rows.append(
            [
                name,
                *(
                    "–" if value is None or not np.isfinite(value) else f"{1e3 * value:.1f}"
                    for value in shown
                ),
            ]
        )
    return Report(
        name="paper_ropes",
        title="Ropes: the priors alone",
        figures=figures,
        header=["scene", "episodes: modal", "chain", "recording: modal", "chain", "twin"],
        rows=rows,
        notes=[
            f"mm. {EPISODES} demonstrations, a quarter of them unseen: mean distance of vertices from the twin, whole "
            "episodes, open loop. Recording: mean track error on the held-out frames. No network, no fine-tuning.",
        ],
        seed=seed,
    )


if __name__ == "__main__":
    run_alone(measure)
