"""Every predictor of the image columns: tracked points of a recording, fitted to its training frames alone.

``PLAN`` lists pieces of work; each gives one or more predictions and is kept on disk. ``NAME@MOTION`` predicts a motion
of :mod:`benchmarks.paper.motions` instead of the recording. All are small (``Settings``): relations are what counts.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.measured.scoring import FAILURES, words
from benchmarks.paper.models import (
    SMALL,
    TRAINING,
    WITHOUT_PRIOR,
    Case,
    demonstrations,
    learn,
    learned_from_recording,
    predicted,
)
from benchmarks.paper.motions import motions
from benchmarks.paper.relations import CONDITIONS
from physworld.arrays import Array
from physworld.baselines import fit_phystwin, fit_spring_gaus
from physworld.baselines.spring_fit import SpringSettings
from physworld.calibrate import CalibrationConfig, calibrate
from physworld.calibrate.global_stage import prior_twin
from physworld.calibrate.local_search import LocalConfig
from physworld.calibrate.local_stage import fit_fields
from physworld.evaluate.baselines import rigid_follow, static
from physworld.scene import Scene
from physworld.twin.twin import Twin
from physworld.video import SplatConfig
from physworld.worldmodel.model.config import FineTuneConfig, TrainingConfig
from physworld.worldmodel.scene_view import view_scene

Tracks = dict[str, Array]
Found = tuple[Tracks, dict[str, Any]]
"""Tracked points (T, N, 3) [m] by prediction, and figures of how they came about."""


@dataclass(frozen=True)
class Settings:
    """Budgets of a run.

    Attributes:
        frames: T of a recording.
        held_out_every, training_every: distance of the frames that are compared.
        episodes: demonstrations of a world model.
        training, alone: of world models, and of the network that has neither demonstrations nor a prior.
        tuning: of Φ.
        fit: of the twin.
        springs: of the spring–mass networks.
        local: of the fields of stiffness.
        splat: of the first frame.
        seed: of everything random.
    """

    frames: int = 60
    held_out_every: int = 3
    training_every: int = 9
    episodes: int = 40
    training: TrainingConfig = field(
        default_factory=lambda: replace(TRAINING, steps=200, validation_every=40)
    )
    alone: TrainingConfig = field(
        default_factory=lambda: replace(WITHOUT_PRIOR, steps=200, validation_every=40)
    )
    tuning: FineTuneConfig = field(default_factory=lambda: FineTuneConfig(steps=20))
    fit: CalibrationConfig = field(
        default_factory=lambda: CalibrationConfig(particle_budget=300, max_simulations=30)
    )
    springs: SpringSettings = field(
        default_factory=lambda: SpringSettings(points=100, population=6, generations=6, epochs=6)
    )
    local: LocalConfig = field(
        default_factory=lambda: LocalConfig(modes=3, strengths=(0.1, 0.01), iterations=6)
    )
    splat: SplatConfig = field(default_factory=lambda: SplatConfig(steps=150, most=4000))
    seed: int = 0


def twin_of(scene: Scene, settings: Settings) -> Twin:
    """The calibrated twin."""
    return calibrate(scene, settings.fit).twin


def baselines(scene: Scene, twin: Twin, settings: Settings) -> Found:
    """The truth, what a film loses by the splat and its skinning alone, what knows no mechanics, and the twin."""
    others = {f"rigid_follow@{name}": rigid_follow(one) for name, one in motions(scene).items()}
    found = {"truth": scene.points, "static": static(scene), "rigid_follow": rigid_follow(scene)}
    found["twin"] = twin.track_nodes(twin.simulate_nodes(*scene.control_track(), scene.times))
    return found | others, {}


def demonstrated(condition: str, scene: Scene, twin: Twin, settings: Settings) -> Found:
    """World models of a condition's demonstrations; of the full one before fine-tuning too, and the twin."""
    case = Case(scene, twin, view_scene(scene, twin, SMALL))
    episodes, _ = demonstrations(case, CONDITIONS[condition], settings.episodes, settings.seed)
    trained = learn(case.view.spec, episodes, settings.seed, settings.training)
    if condition != "full":
        paths, facts = predicted(case, trained, settings.tuning)
        return {condition: paths["world_model_finetuned"]}, facts
    others = {name: view_scene(one, twin, SMALL) for name, one in motions(scene).items()}
    return predicted(case, trained, settings.tuning, others)


def recorded_alone(name: str, scene: Scene, twin: Twin, settings: Settings) -> Found:
    """The network trained on the training frames alone, with the closed-form prior or without it."""
    training = settings.training if name == "recording_alone" else settings.alone
    case = Case(scene, twin, view_scene(scene, twin, SMALL))
    tracks, facts = learned_from_recording(case, replace(training, seed=settings.seed))
    return {name: tracks}, facts | {"twin_steps_per_second": case.view.twin_steps_per_second}


def springs(name: str, scene: Scene, twin: Twin, settings: Settings) -> Found:
    """A fitted spring–mass network."""
    model = {"phystwin": fit_phystwin, "spring_gaus": fit_spring_gaus}[name](scene, settings.springs)
    others = {f"{name}@{motion}": model(one) for motion, one in motions(scene).items()}
    return {name: model(scene)} | others, {"points": model.points, "training_m": model.loss_m}


def stages(scene: Scene, twin: Twin, settings: Settings) -> Found:
    """Fields of stiffness from the prior's twin alone, and on top of the calibrated one."""
    alone = fit_fields(scene, prior_twin(scene, settings.fit), replace(settings.local, deviation=1.0))
    both = fit_fields(scene, twin, settings.local)
    facts = {"local_kept": alone.kept, "global_to_local_kept": both.kept, "why": both.reason}
    return {"local": alone.tracks, "global_to_local": both.tracks}, facts


Work = Callable[[Scene, Twin, Settings], Found]
ALONE = ("recording_alone", "recording_no_prior")
SPRINGS = ("phystwin", "spring_gaus")
PLAN: dict[str, Work] = {
    "baselines": baselines,
    "full": lambda *given: demonstrated("full", *given),
    **{name: lambda *given, n=name: recorded_alone(n, *given) for name in ALONE},
    **{name: lambda *given, n=name: springs(n, *given) for name in SPRINGS},
    "stages": stages,
    **{
        name: lambda *given, n=name: demonstrated(n, *given)
        for name in ("vmp", "linear", "none", "random", "uniform")
    },
}
"""By name, what serves the most cells first."""


def done(work: str, scene: Scene, twin: Twin, settings: Settings) -> Found:
    """The predictions of a piece of work, without those that left the numbers; ``reason`` where there is none.

    Args:
        work: of ``PLAN``.
        scene: the recording.
        twin: its calibrated twin.
        settings: budgets.
    """
    begun = time.process_time()
    try:
        tracks, facts = PLAN[work](scene, twin, settings)
    except FAILURES as error:
        return {}, {"reason": words(error)}
    whole = {name: path for name, path in tracks.items() if np.isfinite(path).all()}
    lost = sorted(set(tracks) - set(whole))
    reason = {"reason": f"{', '.join(lost)} left the numbers"} if lost else {}
    return whole, facts | reason | {"processor_s": round(time.process_time() - begun, 1)}
