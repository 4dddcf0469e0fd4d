"""Scores of predictions of one recording: on held-out frames, against the horizon, and restarted where these begin.

Every score is the mean over frames of the mean distance [m] of predicted to visible measured points
(:func:`physworld.evaluate.metrics.track_error`); frame 0 is never scored, since every prediction starts from it. A
predictor that refuses a recording or fails on it has no score (None) and a reason in words.

Two kinds of horizon, never mixed:

* ``open_loop``: from the first frame of the recording to the horizon. Most of these frames were fitted to (``frames``
  and ``fitted_frames`` say how many), so they show how an error grows, not how a model generalises. ``persistence``
  copies measured frames there and has none.
* ``restarted``: from the first held-out frame, at which every predictor is given the state anew; no frame of it was
  fitted to. Only where tracked points cover the body, and grips are not declared in world coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.baselines import PEERS
from physworld.errors import PhysworldError
from physworld.evaluate.baselines import BASELINES
from physworld.evaluate.metrics import metrics, track_error
from physworld.scene import AS_MEASURED, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

HORIZONS_S = (0.5, 1.0, 2.0, 5.0)
WHOLE = "whole"
SPRINGS = ("phystwin", "spring_gaus")
LEAST_COVERING = 6
"""Tracked points of a rope or sheet from which its shape at a later frame is known well enough to start there."""

Model = Callable[[Scene], Array]
"""Predicts the tracked points (T, N, 3) [m] of any recording from its first frame and its controllers."""
Fit = Callable[[Scene], Model]
"""Fits a model to the training frames of a recording."""
Predictions = dict[str, Array | None]
Reasons = dict[str, str]

FAILURES = (
    PhysworldError, ArithmeticError, AssertionError, AttributeError, LookupError, MemoryError, OSError, RuntimeError,
    TypeError, ValueError,
)  # fmt: skip
"""What is recorded as failed, with its reason, instead of ending the measurement of the others."""


def fits() -> dict[str, Fit]:
    """Everything beside the twin, by name: what does nothing first, then other people's models.

    But not those that take minutes to fit, which have a command of their own (:mod:`benchmarks.measured.springs`).
    """
    peers = {name: fit for name, fit in PEERS.items() if name not in SPRINGS}
    return {name: partial(_as_it_is, baseline) for name, baseline in BASELINES.items()} | peers


def fit_all(scene: Scene) -> tuple[dict[str, Model], Reasons]:
    """Every model that could be fitted to the training frames, and why the others could not."""
    models: dict[str, Model] = {}
    reasons: Reasons = {}
    for name, fit in fits().items():
        try:
            models[name] = fit(scene)
        except FAILURES as error:
            reasons[name] = words(error)
    return models, reasons


def predict(scene: Scene, models: Mapping[str, Model]) -> tuple[Predictions, Reasons]:
    """Tracks (T, N, 3) [m] of every model, None where it has none, and the reasons of these."""
    tracks: Predictions = {}
    reasons: Reasons = {}
    for name, model in models.items():
        tracks[name], reason = attempt(partial(model, scene), scene)
        if reason is not None:
            reasons[name] = reason
    return tracks, reasons


def attempt(compute: Callable[[], Array], scene: Scene) -> tuple[Array | None, str | None]:
    """What ``compute`` predicts, or why there is nothing."""
    try:
        tracks = compute()
    except FAILURES as error:
        return None, words(error)
    if tracks.shape != scene.points.shape:
        return None, f"predicts {tracks.shape}, the recording has {scene.points.shape}"
    if not np.isfinite(tracks).all():
        return None, f"not finite in {int((~np.isfinite(tracks)).any(axis=(1, 2)).sum())} frames"
    return tracks, None


def words(error: BaseException) -> str:
    """An error as a reason."""
    return f"{type(error).__name__}: {error}"


def held_out(scene: Scene, tracks: Predictions) -> dict[str, dict[str, float | None]]:
    """Every metric of every prediction on the held-out frames: metric to predictor to value [m]."""
    window = slice(max(scene.test[0], 1), scene.test[1])
    return {
        metric.name: {
            name: None
            if predicted is None
            else number(
                metric.mean(metric.per_frame(predicted[window], scene.points[window], scene.visible[window]))
            )
            for name, predicted in tracks.items()
        }
        for metric in metrics().values()
    }


def over(scene: Scene, predicted: Array | None, first: int, last: int) -> float | None:
    """Track error [m] over the half-open range of frames; None where nothing was predicted or seen."""
    window = slice(max(first, 1), last)
    if predicted is None or last <= window.start:
        return None
    return number(track_error(predicted[window], scene.points[window], scene.visible[window]))


def against_horizon(scene: Scene, tracks: Predictions) -> dict[str, Any]:
    """Errors [m] from the first frame to every horizon that the recording reaches, and over the whole."""
    elapsed = scene.times - scene.times[0]
    ends = {
        f"{horizon:g}": int(np.searchsorted(elapsed, horizon, side="right"))
        for horizon in HORIZONS_S
        if elapsed[-1] >= horizon
    }
    ends[WHOLE] = scene.frame_count
    return {
        name: {
            "frames": last - 1,
            "fitted_frames": max(0, min(last, scene.train[1]) - max(1, scene.train[0])),
            "track_m": {who: over(scene, predicted, 0, last) for who, predicted in tracks.items()},
        }
        for name, last in ends.items()
    }


def restarted(
    scene: Scene, fitted: Twin, particle_budget: int, models: Mapping[str, Model]
) -> dict[str, Any]:
    """Errors [m] from the first held-out frame, given the state there; ``reason`` where that makes no sense.

    The twin is built anew of the held-out frames, with the fitted law, drag and friction; a rod's natural curvature is
    left out there, for its direction about the axis belongs to the frame of the recording's start. The other models are
    those that were fitted to the training frames.
    """
    reason = why_not_restarted(scene, fitted)
    if reason is not None:
        return {"reason": reason}
    later = cut(scene, scene.test[0])
    tracks, reasons = predict(later, models)
    tracks["twin"], failed = attempt(
        lambda: tracks_of(with_material(fitted, later, particle_budget), later), later
    )
    if failed is not None:
        reasons["twin"] = failed
    return {
        "from_s": float(scene.times[scene.test[0]]),
        "horizons": against_horizon(later, tracks),
        "reasons": reasons,
    }


def why_not_restarted(scene: Scene, fitted: Twin) -> str | None:
    """Why a recording cannot be started at its first held-out frame, or None."""
    if fitted.lattice.dim > 2:
        return "a solid's state inside is not measured at a later frame"
    if scene.points.shape[1] < LEAST_COVERING:
        return f"{scene.points.shape[1]} tracked points do not show the body's shape; {LEAST_COVERING} would"
    if scene.grips or scene.colliders:
        return "its grips or colliders are declared where they are at the first frame"
    if scene.test[1] - scene.test[0] < 3:
        return f"{scene.test[1] - scene.test[0]} held-out frames"
    return None


def cut(scene: Scene, first: int) -> Scene:
    """The recording from frame ``first`` on, its clock at zero there, all of it at once training and held out."""
    start = scene.times[first]
    clock, points = scene.control_times, scene.control_points
    length = scene.frame_count - first
    return replace(
        scene,
        points=scene.points[first:],
        visible=scene.visible[first:],
        controllers=scene.controllers[first:],
        times=scene.times[first:] - start,
        train=(0, length),
        test=(0, length),
        initial_state=AS_MEASURED,
        controller_velocities=None
        if scene.controller_velocities is None
        else scene.controller_velocities[first:],
        control_times=None if clock is None else clock - start,
        control_points=points,
        rest_volume_points=None,
        surface_points=None,
        extra_arrays={},
    )


def with_material(fitted: Twin, scene: Scene, particle_budget: int) -> Twin:
    """A twin of the scene with the fitted law, drag, softness of grips and effects; nothing is fitted.

    Unlike :func:`physworld.calibrate.carried_over`, which finds a rod's rest shape on training frames, it leaves a rod
    without natural curvature: a restarted recording has no frame to find it on.
    """
    twin = build_twin(scene, particle_budget, fitted.device, formulation=fitted.formulation)
    return replace(
        twin,
        law=fitted.law,
        air_drag_per_s=fitted.air_drag_per_s,
        self_friction=None if twin.self_friction is None else fitted.self_friction,
        grip_softness=fitted.grip_softness,
        effects=fitted.effects,
    )


def tracks_of(twin: Twin, scene: Scene) -> Array:
    """Tracked points (T, N, 3) [m] over the whole recording, open loop from its first frame."""
    return twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)


def _as_it_is(baseline: Model, _: Scene) -> Model:
    return baseline


def number(value: float) -> float | None:
    """The value, or None where there is none: JSON knows no NaN."""
    return None if math.isnan(value) else float(value)
