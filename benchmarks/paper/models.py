"""What ``paper_tables`` and ``unseen_motion`` are made of: twins, demonstrations, small world models, their errors.

The models are smaller than the service's (``SMALL``), so that dozens of them can be trained in an hour: relations
between conditions are what counts here, and every condition gets the same network, episodes and optimiser steps.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from physworld.calibrate import CalibrationConfig, calibrate
from physworld.demonstrate import DemonstrationConfig, derived_seed, make_episode
from physworld.errors import EpisodeRejected
from physworld.evaluate.table import held_out_table
from physworld.geometry.rigid import rigid_motion
from physworld.scene import Scene
from physworld.twin.twin import Twin
from physworld.worldmodel.clock import resample, resample_smooth
from physworld.worldmodel.dataset import Track, graph_origin, read_track
from physworld.worldmodel.finetune import fine_tune
from physworld.worldmodel.model.config import FineTuneConfig, TrainingConfig, WorldModelConfig
from physworld.worldmodel.model.graph import GraphSpec, build_graph
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.skinning import affine_skin
from physworld.worldmodel.rollout import rollout
from physworld.worldmodel.scene_view import SceneView, view_scene
from physworld.worldmodel.training import TrainingResult, train
from physworld_scenes.bundle import read_bundle

REPOSITORY = Path(__file__).resolve().parents[2]
SHARED = REPOSITORY.parent / "shared" / "data"
SCENES = {
    "soft_beam": REPOSITORY / "sample" / "soft_beam",
    "d02": SHARED / "undeclared" / "d02",
    "rope_b_shake": SHARED / "real" / "rope_b_shake",
    "rope_a_ring": SHARED / "real" / "rope_a_ring",
}
ORIGIN = {
    "soft_beam": "MuJoCo, known truth",
    "d02": "independent engine, known truth",
    "rope_b_shake": "real recording",
    "rope_a_ring": "real recording",
}
METRICS = ("track_m", "chamfer_phystwin_m", "chamfer_l2_m")

SMALL = WorldModelConfig(hidden=32, message_passing_steps=5, vertices=60)
TRAINING = TrainingConfig(
    steps=80,
    batch_size=4,
    look_ahead=12,
    learning_rate=2e-3,
    validation_every=20,
    checkpoint_every=10_000,
)
WITHOUT_PRIOR = replace(
    TRAINING, prior="none", steps=5 * TRAINING.steps, learning_rate=5e-3, validation_every=40
)
"""Of the network alone: all of the motion is its to learn."""
TUNING = FineTuneConfig(steps=40)
EPISODES = 48
FIT = CalibrationConfig(particle_budget=500, max_simulations=40)
FITS = {"rope_a_ring": CalibrationConfig()}
"""Of scenes whose twin gets the service's budget: one real recording that the twin follows as well as it can."""
SKIN_STATES = 24


@dataclass(frozen=True)
class Case:
    """A scene with its calibrated twin and the graph's view of both."""

    scene: Scene
    twin: Twin
    view: SceneView


def settings(training: TrainingConfig = TRAINING, fit: CalibrationConfig = FIT) -> dict[str, Any]:
    """What a cell's figures depend on beside its own key and the defaults; a change makes cells anew."""
    parts = {"model": SMALL, "training": training, "tuning": TUNING, "fit": fit}
    chosen = {
        f"{name}.{item.name}": getattr(part, item.name)
        for name, part in parts.items()
        for item in fields(part)
        if getattr(part, item.name) != getattr(type(part)(), item.name)
    }
    return {"episodes": EPISODES} | chosen


def scene_of(name: str) -> Scene | None:
    """The scene, None where its recording is not on this machine."""
    path = SCENES[name]
    return read_bundle(path) if path.is_dir() else None


def case_of(name: str, folder: Path) -> Case | None:
    """The scene's case; its twin is calibrated once and kept in ``folder``."""
    scene = scene_of(name)
    if scene is None:
        return None
    path = folder / f"{name}-twin.npz"
    if path.exists():
        with np.load(path, allow_pickle=False) as held:
            twin = Twin.from_arrays({key: held[key] for key in held.files})
    else:
        twin = calibrate(scene, FITS.get(name, FIT)).twin
        folder.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".part.npz")
        np.savez(partial, allow_pickle=False, **twin.to_arrays())
        partial.replace(path)
    return Case(scene, twin, view_scene(scene, twin, SMALL))


def demonstrations(
    case: Case, config: DemonstrationConfig, count: int, seed: int
) -> tuple[list[dict[str, np.ndarray]], int]:
    """``count`` accepted episodes, and how many plans were rejected. Raises EpisodeRejected when hardly any works."""
    episodes: list[dict[str, np.ndarray]] = []
    rejected = index = 0
    while len(episodes) < count:
        try:
            arrays, attributes = make_episode(case.scene, case.twin, config, derived_seed(seed, index))
        except EpisodeRejected:
            rejected += config.attempts
            if rejected > 4 * count:
                raise
        else:
            episodes.append(arrays)
            rejected += len(attributes["rejected"])
        index += 1
    return episodes, rejected


def learn(
    spec: GraphSpec,
    episodes: Sequence[dict[str, np.ndarray]],
    seed: int,
    training: TrainingConfig = TRAINING,
) -> TrainingResult:
    """A small model of these episodes."""
    tracks = [read_track(spec, arrays, SMALL.history) for arrays in episodes]
    return train(tracks, spec, SMALL, replace(training, seed=seed))


def score(case: Case, trained: TrainingResult) -> dict[str, Any]:
    """Held-out errors before and after fine-tuning, of the twin and of the baselines; speeds."""
    paths, facts = predicted(case, trained)
    return {**errors_of(case.scene, paths), **facts}


def predicted(
    case: Case,
    trained: TrainingResult,
    tuning: FineTuneConfig = TUNING,
    others: Mapping[str, SceneView] | None = None,
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tracked points (T, N, 3) [m] of the world model before and after fine-tuning and of the twin; speeds.

    Args:
        case: the recording and its twin.
        trained: the model.
        tuning: of Φ on the training frames.
        others: the same body under other motions by name: the twin and the fine-tuned model predict these too, under
            ``twin@name`` and ``world_model_finetuned@name``.
    """
    view = case.view
    phi = np.zeros((view.spec.object_count, 2))
    tuned = fine_tune(trained.model, phi, view.recording(), view.skin, tuning)
    controllers = view.controllers[view.first :]
    paths, seconds = {}, []
    for name, used in (("world_model", phi), ("world_model_finetuned", tuned.phi)):
        begun = time.perf_counter()
        rolled = rollout(trained.model, view.spec, view.start_history, controllers, used)
        seconds.append(time.perf_counter() - begun)
        paths[name] = view.tracks_of(rolled)
    times = view.scene.times - view.scene.times[0]
    paths["twin"] = resample_smooth(view.twin_tracks, view.times, times)
    for name, other in (others or {}).items():
        rolled = rollout(
            trained.model, view.spec, other.start_history, other.controllers[other.first :], tuned.phi
        )
        # carried by the skin of the recording: another one would have seen the motion
        paths[f"world_model_finetuned@{name}"] = replace(other, skin=view.skin).tracks_of(rolled)
        paths[f"twin@{name}"] = resample_smooth(other.twin_tracks, other.times, times)
    return paths, {
        "best_step": trained.best_step,
        "validation_m": trained.best_error_m,
        "validation_prior_m": trained.prior_error_m,
        "fine_tuning_kept": tuned.kept,
        "steps_per_second": {
            "world_model": (len(controllers) - view.history - 1) / min(seconds),
            "twin": view.twin_steps_per_second,
        },
    }


def errors_of(scene: Scene, paths: dict[str, np.ndarray]) -> dict[str, Any]:
    """The table's means, without what left the numbers."""
    table = held_out_table(scene, {name: path for name, path in paths.items() if np.isfinite(path).all()})
    return {metric: table[metric] for metric in METRICS} | {"noise_floor_m": table["noise_floor_m"]}


def recording_alone(case: Case, seed: int) -> dict[str, Any]:
    """Held-out errors of the same network trained on the recording alone."""
    tracks, facts = learned_from_recording(case, replace(TRAINING, seed=seed))
    return {**errors_of(case.scene, {"recording_alone": tracks}), **facts}


def learned_from_recording(case: Case, training: TrainingConfig) -> tuple[np.ndarray, dict[str, Any]]:
    """Tracked points (T, N, 3) [m] of a network trained on the recording's own training frames, and its speed.

    Its vertices are measured points.
    """
    scene, view = case.scene, case.view
    times = scene.times - scene.times[0]
    points = resample_smooth(filled_in(scene), times, view.times)
    first = points[view.first]
    spec = build_graph(
        first,
        first,
        view.controllers[view.first],
        dt_s=view.spec.dt_s,
        config=SMALL,
        control_groups=case.twin.controller_groups,
        ground_height_m=case.twin.ground_height_m,
    )
    vertices = points[:, spec.particle_index]
    last = int(np.searchsorted(view.times, times[scene.train[1] - 1], side="right"))
    seen = slice(view.first, last)
    together = np.concatenate([vertices[seen], view.controllers[seen][:, spec.control_index]], axis=1)
    together = together - graph_origin(spec, vertices[view.first])
    phi = np.zeros((spec.object_count, 2))
    track = Track(*(_tensor(values) for values in (together, phi)))
    trained = train([track], spec, SMALL, training)
    states = np.unique(np.linspace(view.first, last - 1, SKIN_STATES).round().astype(int))
    skin = affine_skin(points[states], vertices[states])
    start = vertices[view.first : view.first + view.history + 1]
    seconds = []
    for _ in range(2):
        begun = time.perf_counter()
        rolled = rollout(trained.model, spec, start, view.controllers[view.first :], phi)
        seconds.append(time.perf_counter() - begun)
    ticks = skin.apply(np.concatenate([np.repeat(vertices[:1], view.first, axis=0), rolled]))
    return resample_smooth(ticks, view.times, times), {
        "best_step": trained.best_step,
        "diverged": not bool(np.isfinite(ticks).all()),
        "own_steps_per_second": (len(rolled) - view.history - 1) / min(seconds),
    }


def horizon_errors(
    model: WorldModel, spec: GraphSpec, episodes: Sequence[dict[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """Mean distance over vertices from the twin, by predictor: (episodes, frames after the given history) [m].

    ``static``: the last given frame for ever; ``rigid_follow``: as the control vertices move.
    """
    given = model.config.history + 1
    found: dict[str, list[np.ndarray]] = {"world_model": [], "static": [], "rigid_follow": []}
    for arrays in episodes:
        truth = arrays["particles"][:, spec.particle_index].astype(np.float64)
        controllers = arrays["controllers"].astype(np.float64)
        phi = arrays["properties"][spec.particle_index].astype(np.float64)
        turns, shifts = rigid_motion(controllers[given - 1], controllers[given:])
        guesses = {
            "world_model": rollout(model, spec, truth[:given], controllers, phi)[given:],
            "static": np.repeat(truth[given - 1 : given], len(truth) - given, axis=0),
            "rigid_follow": np.einsum("tij,nj->tni", turns, truth[given - 1]) + shifts[:, None],
        }
        for name, guess in guesses.items():
            found[name].append(np.linalg.norm(guess - truth[given:], axis=-1).mean(axis=1))
    return {name: np.stack(curves) for name, curves in found.items()}


def filled_in(scene: Scene) -> np.ndarray:
    """Measured points with hidden ones put in between their neighbours in time, (T, N, 3).

    Those of the training frames from training frames alone.
    """
    points = np.array(scene.points, dtype=np.float64)
    end = scene.train[1]
    for k in range(points.shape[1]):
        for part in (slice(0, end), slice(end, None)):
            seen = np.flatnonzero(scene.visible[part, k])
            if len(seen) and len(seen) < len(scene.times[part]):
                times = scene.times[part]
                points[part, k] = resample(points[part, k][seen], times[seen], times)
    return points


def _tensor(values: np.ndarray) -> Any:
    import torch

    return torch.as_tensor(values, dtype=torch.float32)
