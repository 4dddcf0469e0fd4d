"""One recording: its twin fitted with the library's default, and every predictor scored on it."""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measured import scoring
from physworld.calibrate import CalibrationConfig, FitResult, calibrate, carried_over
from physworld.estimation.simulations import engine
from physworld.evaluate.metrics import noise_floor
from physworld.evaluate.numerics import dominant_frequency
from physworld.scene import Scene
from physworld.twin.twin import Twin
from physworld_scenes.bundle import canonical_archive
from physworld_workers.commands.steps import journal_in

PUBLISHED = Path(__file__).with_name("published.json")
COPIES = "persistence"  # follows measured frames of training: no error against the horizon


def key_of(scene: Scene, config: CalibrationConfig) -> str:
    """What a finished recording belongs to: its data, the settings, the engine and the predictors."""
    digest = hashlib.sha256(canonical_archive(scene)).hexdigest()
    return f"{digest} {engine()} {config} {sorted(scoring.fits())}"


def measure(name: str, scene: Scene, config: CalibrationConfig, steps: Path) -> dict[str, Any]:
    """Figures of one recording under stable keys (``docs/measured.md``); what has none is None, with a reason.

    Args:
        name: of the recording in its set.
        scene: the recording.
        config: of the calibration.
        steps: folder of the fit's finished steps, where its twin is kept too.
    """
    begun = time.perf_counter()
    models, unfit = scoring.fit_all(scene)
    tracks, reasons = scoring.predict(scene, models)
    reasons |= unfit
    tracks |= dict.fromkeys(unfit)
    fitted, failure = fit_twin(name, scene, config, steps)
    found = None if fitted is None else scoring.attempt(lambda: fitted.tracks, scene)
    tracks["twin"] = None if found is None else found[0]
    reason = failure if found is None else found[1]
    if reason is not None:
        reasons["twin"] = reason
    moving = {who: model for who, model in models.items() if who != COPIES}
    open_loop = scoring.against_horizon(scene, {who: of for who, of in tracks.items() if who != COPIES})
    return {
        "kind": scene.kind,
        "frames": scene.frame_count,
        "points": scene.points.shape[1],
        "train": list(scene.train),
        "test": list(scene.test),
        "noise_floor_m": None if scene.noise_sigma_m is None else noise_floor(scene.noise_sigma_m),
        **scoring.held_out(scene, tracks),
        "reason": reasons,
        "horizons": {
            "open_loop": open_loop,
            "restarted": {"reason": "there is no twin"}
            if fitted is None
            else scoring.restarted(scene, fitted.twin, config.particle_budget, moving),
        },
        "frequency_hz": _frequencies(scene, tracks["twin"]),
        **_of_fit(fitted),
        "published": published(scene),
        "seconds": time.perf_counter() - begun,
        "key": key_of(scene, config),
    }


def transfer(
    source: Scene, twin: Path, scene: Scene, config: CalibrationConfig, own: dict[str, float | None]
) -> dict[str, Any]:
    """A recording predicted with the material of another one (:func:`physworld.calibrate.carried_over`).

    What belongs to this recording is found on its training frames, nothing else is: the roll and rest shape of a
    discrete rod, release and level of a solid, places of tracked points. The other models are those fitted to the other
    recording.

    Args:
        source: the other recording; every model is fitted to its training frames.
        twin: its fitted twin, as ``measure`` keeps it.
        scene: what is predicted.
        config: of the calibration.
        own: held-out track errors of this recording's own predictors [m].
    """
    whole: scoring.Predictions
    models, unfit = scoring.fit_all(source)
    whole, reasons = scoring.predict(scene, {name: model for name, model in models.items() if name != COPIES})
    reasons |= unfit
    whole |= dict.fromkeys(unfit)

    def compute() -> Any:
        with np.load(twin) as stored:
            fitted = Twin.from_arrays(dict(stored), config.device)
        return scoring.tracks_of(carried_over(fitted, scene, config.particle_budget), scene)

    if twin.exists():
        whole["twin"], failure = scoring.attempt(compute, scene)
    else:
        whole["twin"], failure = None, f"there is no twin {twin.name}"
    if failure is not None:
        reasons["twin"] = failure
    return {
        "track_m": {
            name: scoring.over(scene, predicted, 0, scene.frame_count) for name, predicted in whole.items()
        },
        "held_out_track_m": {
            **{name: scoring.over(scene, predicted, *scene.test) for name, predicted in whole.items()},
            "twin_fitted_here": own.get("twin"),
        },
        "frequency_hz": _frequencies(scene, whole["twin"]),
        "reason": reasons,
    }


def twin_file(steps: Path, name: str) -> Path:
    """Where the fitted twin of a recording is kept."""
    return steps / f"{name}.twin.npz"


def published(scene: Scene) -> list[dict[str, Any]]:
    """What the source of a recording has published of its own models' errors; a value that is not known is None."""
    declared = json.dumps(scene.declared)
    entries: list[dict[str, Any]] = json.loads(PUBLISHED.read_text())["entries"]
    return [entry for entry in entries if entry["source"] in declared]


def fit_twin(
    name: str, scene: Scene, config: CalibrationConfig, steps: Path
) -> tuple[FitResult | None, str | None]:
    """The calibrated twin, kept in ``steps``, or why there is none; a search that was cut off goes on."""
    try:
        fitted = calibrate(scene, config, journal=journal_in(steps / f"{name}.json", scene, f"{config}"))
    except scoring.FAILURES as error:
        return None, scoring.words(error)
    np.savez_compressed(twin_file(steps, name), **fitted.twin.to_arrays())
    return fitted, None


def _of_fit(fitted: FitResult | None) -> dict[str, Any]:
    if fitted is None:
        return {"parameters": None, "searched": None, "simulations": None, "fit_seconds": None, "open": None}
    return {
        "parameters": {name: asdict(estimate) for name, estimate in fitted.parameters.items()},
        "searched": [parameter.name for parameter in fitted.searched],
        "formulation": fitted.twin.formulation,
        "law": type(fitted.twin.law).__name__,
        "simulations": fitted.simulations,
        "fit_seconds": fitted.seconds,
        "open": fitted.open,
    }


def _frequencies(scene: Scene, twin: Any) -> dict[str, float | None]:
    """Strongest frequency [Hz] of the first principal motion over all frames, of the twin and as measured."""
    return {
        "twin": None if twin is None else dominant_frequency(scene.times, twin),
        "measured": dominant_frequency(scene.times, scene.points),
    }
