"""The ``assessment`` shard: a new recording of an object held against a published model of it.

The model is rolled out over the recording, open loop from its start. Its mean track error is compared with what noise
alone shows and with the held-out error on the model's card, both with intervals by blocks of frames
(:mod:`physworld.evaluate.blocks`). What follows from a model that has become worse is the database's business: the
commit opens a trace (``physworld_storage.jobs.kinds.assessment``).
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
from safetensors.numpy import load as load_tensors

from physworld.errors import SceneUnsupported
from physworld.evaluate.blocks import AS_EXPECTED, WITHIN_NOISE, Comparison, Mean, compare
from physworld.evaluate.metrics import noise_floor, track_error_per_frame
from physworld.evaluate.table import held_out_table
from physworld.scene import Scene
from physworld.worldmodel.foreign import ForeignPrediction, predict, twin_on
from physworld.worldmodel.published import PublishedModel
from physworld_schemas.base import Reference
from physworld_schemas.model import ModelVersion
from physworld_services.trainer.closed_loop import METRIC, WORLD_MODEL
from physworld_services.trainer.measuring import json_safe
from physworld_storage import registry, resources
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.lineage import lineage_of
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import named, scene_of, scene_reference, twin_of

PLACING, ROLLING, COMPARING = (
    "placing the twin", "rolling the model out over the recording", "comparing with noise and card",
)  # fmt: skip
BASELINES = ("static", "rigid_follow", "constant_velocity")


def run(context: TaskContext, stores: Stores) -> HandlerResult:
    """Roll out, compare, say."""
    payload = context.lease.payload
    with stores.database.reading() as session:
        version = registry.get_version(session, payload["name"], payload["version"])
        fit = resources.get_fit(session, payload["fit_id"])
    recording, home = scene_of(stores, payload["scene_id"]), scene_of(stores, payload["model_scene_id"])
    twin = twin_of(stores, payload["fit_id"], payload.get("trace_id"))
    context.plan({PLACING: 1.0, ROLLING: 1.0, COMPARING: 1.0})
    context.begin(PLACING)
    placed = twin_on(recording, home, twin, fit.config.particle_budget)
    context.begin(ROLLING, "rollouts")
    predicted = predict(_model(stores, version), recording, placed)
    context.begin(COMPARING)
    found = assess(recording, predicted, version)
    inputs = [
        Reference(
            kind="model", id=registry.reference_id(version.name, version.version), digest=version.sha256
        ),
        scene_reference(stores, payload["scene_id"]),
    ]
    return HandlerResult({**found, "lineage": lineage_of(inputs, {}, {})})


def assess(recording: Scene, predicted: ForeignPrediction, version: ModelVersion) -> dict[str, Any]:
    """The answer's figures. Raises SceneUnsupported when the model left the numbers or nothing can be scored."""
    window = slice(max(1, predicted.first_frame), recording.frame_count)
    measured, visible = recording.points[window], recording.visible[window]
    errors = track_error_per_frame(predicted.tracks[window], measured, visible)
    if not np.isfinite(predicted.tracks[window]).all() or not np.isfinite(errors).any():
        raise SceneUnsupported(
            f"of {len(errors)} frames after the model's history {int(np.isfinite(errors).sum())} can be scored"
        )
    curve = version.metrics["held_out"]["per_frame"][METRIC].get(WORLD_MODEL, [])
    promised = [np.nan if value is None else value for value in curve]
    if not np.isfinite(promised).any():
        raise SceneUnsupported(
            f"version {version.version} of {version.name} has no error of its own on held-out frames to compare with: "
            "its prediction left the numbers there, or nothing was visible"
        )
    floors = (
        None if recording.noise_sigma_m is None else noise_floor(recording.noise_sigma_m),
        version.metrics.get("noise_floor_m"),
    )
    comparison = compare(errors, floors[0], np.array(promised), floors[1])
    baselines = held_out_table(_scored(recording, window), {})[METRIC]
    twin_errors = track_error_per_frame(predicted.twin_tracks[window], measured, visible)
    answer = {
        "outcome": comparison.outcome,
        "reason": sentence(comparison, floors[0]),
        "measured": _wire(comparison.measured, floors[0]),
        "expected": _wire(comparison.expected, floors[1]),
        "excess_m": comparison.excess,
        "excess_ci95_m": list(comparison.excess_ci95),
        "baselines_m": {name: baselines[name] for name in BASELINES},
        "twin_m": float(np.nanmean(twin_errors)),
        "start_mismatch_m": predicted.start_mismatch_m,
    }
    plain: dict[str, Any] = json_safe(answer)
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


def _model(stores: Stores, version: ModelVersion) -> PublishedModel:
    read = stores.artifacts.read_bytes
    card = json.loads(read(named(version.artifacts, "card.json", version.name).sha256))
    tensors = load_tensors(read(named(version.artifacts, "model.safetensors", version.name).sha256))
    return PublishedModel.from_card(tensors, card)
