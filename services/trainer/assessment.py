"""The ``assessment`` shard: a new recording of an object held against a published model of it.

The model is rolled out over the recording, open loop from its start. Its mean track error is compared with what noise
alone shows and with the held-out error on the model's card, both with intervals by blocks of frames
(:mod:`physworld.estimation.blocks`). Scored are all frames after the model's history, or of these the recording's
held-out ones alone; another version of the model may be measured on the same frames. What follows from a model that has
become worse is the database's business: the commit opens a trace (``physworld_storage.jobs.kinds.assessment``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.errors import SceneUnsupported
from physworld.estimation.blocks import (
    AS_EXPECTED,
    WITHIN_NOISE,
    Comparison,
    Mean,
    compare,
    mean_with_interval,
    paired_gain,
)
from physworld.estimation.noise import held_out_frames
from physworld.evaluate.metrics import noise_floor, track_error_per_frame
from physworld.evaluate.table import held_out_table
from physworld.scene import Scene
from physworld.twin.twin import Twin
from physworld.worldmodel.foreign import ForeignPrediction, predict, twin_on
from physworld_schemas.base import Reference
from physworld_schemas.model import ModelVersion
from physworld_services.trainer.closed_loop import METRIC, WORLD_MODEL
from physworld_services.trainer.measuring import json_safe
from physworld_services.trainer.publishing import model_of
from physworld_storage import registry, resources
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.lineage import lineage_of
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import scene_of, scene_reference, twin_of

PLACING, ROLLING, COMPARING = (
    "placing the twin", "rolling the model out over the recording", "comparing with noise and card",
)  # fmt: skip
PLACING_OTHER, ROLLING_OTHER = "placing the other version's twin", "rolling the other version out"
BASELINES = ("static", "rigid_follow", "constant_velocity")


def run(context: TaskContext, stores: Stores) -> HandlerResult:
    """Roll out, compare, say."""
    payload = context.lease.payload
    recording = scene_of(stores, payload["scene_id"])
    other = payload.get("compared")
    origins = [payload] if other is None else [payload, other]
    stages = [(PLACING, ROLLING), (PLACING_OTHER, ROLLING_OTHER)][: len(origins)]
    context.plan({stage: 1.0 for pair in stages for stage in pair} | {COMPARING: 1.0})
    versions, predictions = [], []
    for origin, (placing, rolling) in zip(origins, stages, strict=True):
        with stores.database.reading() as session:
            version = registry.get_version(session, payload["name"], origin["version"])
        context.begin(placing)
        placed = _placed(stores, recording, origin)
        context.begin(rolling, "rollouts")
        versions.append(version)
        predictions.append(predict(model_of(stores, version), recording, placed))
    context.begin(COMPARING)
    first = max(predicted.first_frame for predicted in predictions)
    window = scored_frames(recording, first, payload.get("frames", "all"))
    found = assess(recording, predictions[0], versions[0], window)
    for version, predicted in zip(versions[1:], predictions[1:], strict=True):
        found["compared"] = compared(recording, predictions[0], version, predicted, window)
    inputs = [
        *(
            Reference(kind="model", id=registry.reference_id(one.name, one.version), digest=one.sha256)
            for one in versions
        ),
        scene_reference(stores, payload["scene_id"]),
    ]
    return HandlerResult({**found, "lineage": lineage_of(inputs, {}, {})})


def scored_frames(recording: Scene, first: int, frames: str) -> slice:
    """Which frames of a recording are scored. Raises SceneUnsupported when none is left.

    Args:
        recording: of the object.
        first: first frame that every network predicted by itself.
        frames: "all", or "held_out": of these the ones that a trace of the recording does not look at.
    """
    begin, end = 1, recording.frame_count
    if frames == "held_out":
        begin, end = held_out_frames(recording)
    window = slice(max(begin, first, 1), end)
    if window.start >= window.stop:
        raise SceneUnsupported(
            f"no frame can be scored: frames {begin} to {end} are asked for, and the model predicts from {first} on"
        )
    return window


def assess(
    recording: Scene, predicted: ForeignPrediction, version: ModelVersion, window: slice
) -> dict[str, Any]:
    """The answer's figures. Raises SceneUnsupported when the model left the numbers or nothing can be scored.

    Args:
        recording: of the object.
        predicted: by the version.
        version: with the errors of its card.
        window: frames that are scored.
    """
    errors = _errors(recording, predicted.tracks, window)
    curve = version.metrics["held_out"]["per_frame"][METRIC].get(WORLD_MODEL, [])
    promised = [np.nan if value is None else value for value in curve]
    if not np.isfinite(promised).any():
        raise SceneUnsupported(
            f"version {version.version} of {version.name} has no error of its own on held-out frames to compare with: "
            "its prediction left the numbers there, nothing was visible, or it is for other grips than hold there"
        )
    floors = (_floor(recording), version.metrics.get("noise_floor_m"))
    comparison = compare(errors, floors[0], np.array(promised), floors[1])
    baselines = held_out_table(_scored(recording, window), {})[METRIC]
    answer = {
        "outcome": comparison.outcome,
        "reason": sentence(comparison, floors[0]),
        "measured": _wire(comparison.measured, floors[0]),
        "expected": _wire(comparison.expected, floors[1]),
        "excess_m": comparison.excess,
        "excess_ci95_m": list(comparison.excess_ci95),
        "baselines_m": {name: baselines[name] for name in BASELINES},
        "twin_m": _twin_error(recording, predicted, window),
        "start_mismatch_m": predicted.start_mismatch_m,
    }
    plain: dict[str, Any] = json_safe(answer)
    return plain


def compared(
    recording: Scene,
    predicted: ForeignPrediction,
    version: ModelVersion,
    other: ForeignPrediction,
    window: slice,
) -> dict[str, Any]:
    """Another version on the same frames, and what it errs more than the assessed one, by paired blocks.

    Args:
        recording: of the object.
        predicted: by the assessed version.
        version: the other one.
        other: by the other one.
        window: frames that are scored.

    Raises:
        SceneUnsupported: the other version left the numbers.
    """
    errors = _errors(recording, other.tracks, window)
    gain = paired_gain(errors, _errors(recording, predicted.tracks, window))
    plain: dict[str, Any] = json_safe(
        {
            "version": version.version,
            "measured": _wire(mean_with_interval(errors), _floor(recording)),
            "twin_m": _twin_error(recording, other, window),
            "gain_m": gain.value,
            "gain_ci95_m": list(gain.ci95),
        }
    )
    return plain


def sentence(comparison: Comparison, floor: float | None) -> str:
    """The outcome in one sentence, with its numbers."""
    new, old = comparison.measured, comparison.expected
    figures = (
        f"{_millimetres(new)} on this recording, {_millimetres(old)} promised"
        f"{'' if floor is None else f', noise alone {1e3 * floor:.3g} mm'}"
    )
    if comparison.outcome == WITHIN_NOISE:
        return f"The model is within the noise of this recording: {figures}"
    if comparison.outcome == AS_EXPECTED:
        return f"The model errs as its card lets expect: {figures}"
    return f"The model errs more than noise and its card allow: {figures}"


def _millimetres(mean: Mean) -> str:
    return f"{1e3 * mean.value:.3g} mm (95 % {1e3 * mean.ci95[0]:.3g} to {1e3 * mean.ci95[1]:.3g})"


def _wire(mean: Mean, floor: float | None) -> dict[str, Any]:
    return {
        "error_m": mean.value,
        "ci95_m": list(mean.ci95),
        "noise_floor_m": floor,
        "frames": mean.frames,
    }


def _scored(recording: Scene, window: slice) -> Scene:
    """The recording with the scored frames as its held-out ones, as the table of baselines reads it."""
    return replace(recording, test=(window.start, window.stop))


def _errors(recording: Scene, tracks: Array, window: slice) -> Array:
    """Mean track error of every scored frame (F,) [m]. Raises SceneUnsupported when nothing can be scored."""
    errors = track_error_per_frame(tracks[window], recording.points[window], recording.visible[window])
    if not np.isfinite(tracks[window]).all() or not np.isfinite(errors).any():
        raise SceneUnsupported(
            f"of {len(errors)} scored frames {int(np.isfinite(errors).sum())} can be scored: "
            "the model left the numbers, or nothing was visible"
        )
    return errors


def _twin_error(recording: Scene, predicted: ForeignPrediction, window: slice) -> float:
    errors = track_error_per_frame(
        predicted.twin_tracks[window], recording.points[window], recording.visible[window]
    )
    return float(np.nanmean(errors))


def _floor(recording: Scene) -> float | None:
    return None if recording.noise_sigma_m is None else noise_floor(recording.noise_sigma_m)


def _placed(stores: Stores, recording: Scene, origin: dict[str, Any]) -> Twin:
    """The twin of a version, put where the recording starts."""
    with stores.database.reading() as session:
        fit = resources.get_fit(session, origin["fit_id"])
    home = scene_of(stores, origin["model_scene_id"])
    twin = twin_of(stores, origin["fit_id"], origin.get("trace_id"))
    return twin_on(recording, home, twin, fit.config.particle_budget)
