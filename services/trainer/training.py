"""The ``training`` shard: from a dataset to a published world model.

Reads the episodes (``services.trainer.episodes``), trains with a checkpoint every few hundred steps, kept in the
scratch store (a killed trainer, or another one in its place, carries on from the last one), fine-tunes the properties
on the recording's training frames, measures everything open loop on the frames that were held out, and stores the
version's files:

* ``model.safetensors``: see ``physworld.worldmodel.model`` and ``.published``;
* ``step.pt2``, ``step.onnx``: one step as a program (``physworld.worldmodel.export``);
* ``card.json``: lineage, architecture, metrics, seeds, versions, intended use, limits;
* ``prediction.npz``: ``times`` (T,) f8 [s], ``tracks`` and ``tracks_calibrated`` (T, N, 3) f4 [m] after and
  before fine-tuning, ``twin_tracks``; ``tick_times`` (S,) f8 and ``vertices`` (S, n, 3) f4 on the model's
  clock;
* ``manifest.json``: sha256 and size of each of them; its digest is the version's;
* ``manifest.sig.json``: the installation's signature of the manifest (``storage.signing``).
"""

from __future__ import annotations

import json
import logging
import math
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save as save_tensors

from physworld.demonstrate.config import StrengthRange
from physworld.evaluate.blocks import mean_with_interval
from physworld.evaluate.table import held_out_table
from physworld.worldmodel import config as settings_of
from physworld.worldmodel import export
from physworld.worldmodel.clock import resample_smooth
from physworld.worldmodel.errors import CheckpointMismatch, TrainingCancelled
from physworld.worldmodel.finetune import FineTuneResult, fine_tune
from physworld.worldmodel.published import PublishedModel
from physworld.worldmodel.scene_view import SceneView, view_scene
from physworld.worldmodel.training import TrainingResult, first_episodes, train
from schemas.base import Artifact
from schemas.model import TrainingConfig
from schemas.signing import SIGNATURE_NAME
from services.trainer.closed_loop import closed_loop
from services.trainer.episodes import Episodes, half
from storage import signing, traces
from workers.context import TaskContext
from workers.lineage import lineage_of
from workers.registry import HandlerResult
from workers.stores import Stores
from workers.tasks.dataset import strength_ranges
from workers.tasks.inputs import made_from, npz_bytes, scene_of, twin_of

logger = logging.getLogger(__name__)

CHECKPOINT = "training.pt"
MANIFEST_NAME = "manifest.json"
PROGRAMS = {"torch_export": ("step.pt2", export.torch_program), "onnx": ("step.onnx", export.onnx_program)}
SPEED_REPEATS = 3


@dataclass(frozen=True)
class Measured:
    """Predictions of tracked points at the measured times (T, N, 3) [m], their table, steps per second."""

    tracks: np.ndarray
    tracks_calibrated: np.ndarray
    twin_tracks: np.ndarray
    vertices: np.ndarray
    table: dict[str, Any]
    steps_per_second: dict[str, float]


def run(context: TaskContext, stores: Stores) -> HandlerResult:
    """Train, fine-tune, measure, store."""
    payload = context.lease.payload
    config = TrainingConfig.model_validate(payload["config"])
    architecture, training, tuning = translate(config)
    scene = scene_of(stores, payload["scene_id"])
    twin = twin_of(stores, payload["fit_id"], payload.get("trace_id"))
    context.progress(0, config.steps, "steps", "reading the dataset")
    view = view_scene(scene, twin, architecture)
    strengths = _strengths(stores, payload)
    episodes = Episodes(context, stores, payload["dataset_id"], view.spec, architecture.history, strengths)
    started = time.perf_counter()
    trained = _train(context, stores, episodes, view, architecture, training)
    training_s = time.perf_counter() - started
    context.progress(config.steps, config.steps, "steps", "fine-tuning on the recording")
    phi = np.zeros((view.spec.object_count, 2))
    started = time.perf_counter()
    tuned = _stopping(
        context,
        lambda: fine_tune(
            trained.model,
            phi,
            view.recording(),
            view.skin,
            tuning,
            bounds=episodes.bounds(),
            cancelled=context.cancelled,
        ),
    )
    tuning_s = time.perf_counter() - started
    context.progress(config.steps, config.steps, "steps", "measuring on the held-out frames")
    found = torch.as_tensor(tuned.strengths, dtype=torch.float32)
    published = view.published(trained.model.at_strengths(found), tuned.phi, phi)
    before = view.published(trained.model.at_strengths(torch.zeros_like(found)), phi, phi)
    measured = measure(view, published, before)
    seconds = {"training": training_s, "fine_tuning": tuning_s}
    metrics = json_safe(_metrics(view, trained, tuned, measured, seconds))
    metrics["fine_tuning"]["strengths"] = json_safe(_tuned_strengths(episodes.strengths, tuned.strengths))
    metrics["closed_loop"] = json_safe(closed_loop(stores, payload, metrics, architecture))
    dataset = episodes.sealed()
    lineage = lineage_of([dataset, *made_from(stores, payload)], payload["config"], {"training": config.seed})
    card = _card(payload, config, published, metrics, lineage) | {"trained_on": episodes.description()}
    artifacts = _store(stores, payload, published, view, measured, card)
    manifest = next(artifact for artifact in artifacts if artifact.name == MANIFEST_NAME)
    context.check()
    stores.scratch.remove(context.lease.job_id)
    result = {
        "artifacts": [artifact.model_dump(mode="json") for artifact in artifacts],
        "sha256": manifest.sha256,
        "metrics": metrics,
        "lineage": lineage,
    }
    return HandlerResult(result, manifest.sha256)


def translate(
    config: TrainingConfig,
) -> tuple[settings_of.WorldModelConfig, settings_of.TrainingConfig, settings_of.FineTuneConfig]:
    """The wire's settings as the library's; threads from ``PHYSWORLD_TRAINER_THREADS``, 1 without it."""
    interval = max(1, min(250, config.steps // 8))
    return (
        settings_of.WorldModelConfig(
            hidden=config.hidden,
            message_passing_steps=config.message_passing_steps,
            history=config.history,
            vertices=config.vertices,
        ),
        settings_of.TrainingConfig(
            steps=config.steps,
            batch_size=config.batch_size,
            look_ahead=config.look_ahead,
            learning_rate=config.learning_rate,
            validation_every=interval,
            patience=config.patience,
            start_share=config.start_share,
            checkpoint_every=interval,
            threads=int(os.environ.get("PHYSWORLD_TRAINER_THREADS", "1")),
            seed=config.seed,
        ),
        settings_of.FineTuneConfig(steps=config.fine_tune_steps),
    )


def measure(view: SceneView, published: PublishedModel, before: PublishedModel | None = None) -> Measured:
    """Open-loop predictions over the whole recording, and what they cost; ``before``: without fine-tuned strengths."""
    controllers = view.controllers[view.first :]
    seconds = []
    for _ in range(SPEED_REPEATS):
        started = time.perf_counter()
        rolled = published.rollout(controllers)
        seconds.append(time.perf_counter() - started)
    calibrated = (before or published).rollout(controllers, phi=published.phi_calibrated)
    frame_times = view.scene.times - view.scene.times[0]
    tracks, tracks_calibrated = view.tracks_of(rolled), view.tracks_of(calibrated)
    twin_tracks = resample_smooth(view.twin_tracks, view.times, frame_times)
    predictions = {"twin": twin_tracks, "world_model": tracks_calibrated, "world_model_finetuned": tracks}
    finite = {name: path for name, path in predictions.items() if np.isfinite(path).all()}
    table = _with_intervals(held_out_table(view.scene, finite))
    return Measured(
        tracks=tracks,
        tracks_calibrated=tracks_calibrated,
        twin_tracks=twin_tracks,
        vertices=np.concatenate([np.repeat(view.vertices[:1], view.first, axis=0), rolled]),
        table=_with_absent(table, sorted(set(predictions) - set(finite))),
        steps_per_second={
            "twin": view.twin_steps_per_second,
            "world_model": (len(rolled) - view.history - 1) / min(seconds),
        },
    )


def json_safe(value: Any) -> Any:
    """Plain JSON types; a number that is not finite (a rollout that blew up) becomes None."""
    if isinstance(value, dict):
        return {str(key): json_safe(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_safe(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _with_intervals(table: dict[str, Any]) -> dict[str, Any]:
    """The table with ``ci95``: metric to name to the 95 % interval of the mean [m], by blocks of frames."""
    table["ci95"] = {
        metric: {
            name: list(mean_with_interval(np.array(curve, dtype=float)).ci95)
            for name, curve in table["per_frame"][metric].items()
            if any(value is not None for value in curve)
        }
        for metric in ("track_m", "chamfer_phystwin_m", "chamfer_l2_m")
    }
    return table


def _with_absent(table: dict[str, Any], absent: list[str]) -> dict[str, Any]:
    """The table with None for predictions that left the numbers: they have no error, and the rest is published."""
    for name in absent:
        for metric in ("track_m", "track_phystwin_m", "chamfer_phystwin_m", "chamfer_l2_m"):
            table[metric][name] = None
    return table


def _strengths(stores: Stores, payload: dict[str, Any]) -> tuple[StrengthRange, ...]:
    """Strengths that the dataset's trace found, with their intervals."""
    if payload.get("trace_id") is None:
        return ()
    with stores.database.reading() as session:
        trace = traces.get_trace(session, payload["trace_id"])
    return strength_ranges(trace.effects) if traces.adds_effects(trace) else ()


def _tuned_strengths(ranges: Sequence[StrengthRange], found: np.ndarray) -> dict[str, Any]:
    """Strengths of effects at which the version stands, beside what the trace said."""
    return {
        f"{one.effect}.{one.name}": {
            "calibrated": one.value,
            "ci95": [one.low, one.high],
            "tuned": one.value + half(one) * float(value),
        }
        for one, value in zip(ranges, found, strict=True)
    }


def _train(
    context: TaskContext,
    stores: Stores,
    episodes: Episodes,
    view: SceneView,
    architecture: settings_of.WorldModelConfig,
    training: settings_of.TrainingConfig,
) -> TrainingResult:
    """Train, from the checkpoint of an earlier attempt where there is one."""
    job_id = context.lease.job_id
    first = first_episodes(episodes.total, training.start_share)
    tracks = [episodes.track(index) for index in range(first)]

    def progress(step: int, steps: int, loss: float) -> None:
        episodes.reached = (step, steps)
        context.progress(step, steps, "steps", f"loss {loss:.4g}")

    def attempt(checkpoint: bytes | None) -> TrainingResult:
        return train(
            tracks,
            view.spec,
            architecture,
            training,
            total=episodes.total,
            later=episodes.track,
            checkpoint=checkpoint,
            save_checkpoint=lambda data: stores.scratch.put(job_id, CHECKPOINT, data),
            progress=progress,
            cancelled=context.cancelled,
        )

    try:
        return _stopping(context, lambda: attempt(stores.scratch.get(job_id, CHECKPOINT)))
    except CheckpointMismatch as mismatch:
        logger.warning("job %s starts anew: %s", job_id, mismatch)
        return _stopping(context, lambda: attempt(None))


def _stopping(context: TaskContext, work: Any) -> Any:
    """``work()``; a cancellation that it noticed ends the shard as the worker's own does."""
    try:
        return work()
    except TrainingCancelled:
        context.check()
        raise


def _metrics(
    view: SceneView,
    trained: TrainingResult,
    tuned: FineTuneResult,
    measured: Measured,
    seconds: dict[str, float],
) -> dict[str, Any]:
    return {
        "held_out": measured.table,
        "steps_per_second": measured.steps_per_second,
        "noise_floor_m": measured.table["noise_floor_m"],
        "seconds": seconds,
        "episodes": trained.episodes,
        "validation": {
            "open_loop_m": trained.best_error_m,
            "static_m": trained.static_error_m,
            "prior_m": trained.prior_error_m,
            "best_step": trained.best_step,
            "steps": trained.steps,
            "curve": trained.validation,
            "training_loss": trained.losses,
        },
        "fine_tuning": {
            "kept": tuned.kept,
            "inner_validation_before_m": tuned.error_before_m,
            "inner_validation_after_m": tuned.error_after_m,
            "steps": tuned.steps,
            "phi_rms": float(np.sqrt((tuned.phi**2).mean())),
        },
        "skin_error_m": view.skin_error_m,
        "world_model_against_twin_m": float(
            np.linalg.norm(measured.tracks_calibrated - measured.twin_tracks, axis=2).mean()
        ),
    }


def _card(
    payload: dict[str, Any],
    config: TrainingConfig,
    published: PublishedModel,
    metrics: dict[str, Any],
    lineage: dict[str, Any],
) -> dict[str, Any]:
    return {
        "schema_version": 1,
        "name": payload["name"],
        "version": payload["version"],
        "scene_id": payload["scene_id"],
        "fit_id": payload["fit_id"],
        "trace_id": payload.get("trace_id"),
        "dataset_id": payload["dataset_id"],
        "closed_loop": metrics["closed_loop"],
        "dt_s": published.spec.dt_s,
        "architecture": published.facts(),
        "training": config.model_dump(mode="json"),
        "library_settings": [asdict(part) for part in translate(config)],
        "metrics": {name: value for name, value in metrics.items() if name != "closed_loop"},
        "lineage": lineage,
        "seeds": {"training": config.seed},
        "versions": {
            "torch": torch.__version__,
            "numpy": np.__version__,
            "physworld": lineage["code_version"],
        },
        "intended_use": (
            "Predict the motion of this object under motions of its grips like those of the demonstrations, "
            "open loop, at the clock dt_s."
        ),
        "limits": (
            "One object and its grips, as recorded: edges are material, so contact of the object with itself, "
            "fracture, flow and other grips are not represented; motions much faster or wider than the "
            "demonstrations are extrapolated; the start needs history + 1 frames."
        ),
    }


def _store(
    stores: Stores,
    payload: dict[str, Any],
    published: PublishedModel,
    view: SceneView,
    measured: Measured,
    card: dict[str, Any],
) -> list[Artifact]:
    """The version's files, the manifest and its signature last."""
    put = stores.artifacts.put_bytes
    prediction = {
        "times": view.scene.times,
        "tracks": measured.tracks.astype(np.float32),
        "tracks_calibrated": measured.tracks_calibrated.astype(np.float32),
        "twin_tracks": measured.twin_tracks.astype(np.float32),
        "tick_times": view.times,
        "vertices": measured.vertices.astype(np.float32),
    }
    facts = {"format": "physworld-world-model", "name": payload["name"], "version": str(payload["version"])}
    programs = [
        put(PROGRAMS[name][1](published.model), PROGRAMS[name][0], "application/octet-stream")
        for name in dict.fromkeys(card["training"]["formats"])
    ]
    artifacts = [
        put(save_tensors(published.to_tensors(), facts), "model.safetensors", "application/octet-stream"),
        *programs,
        put(json.dumps(card, indent=1, allow_nan=False).encode(), "card.json", "application/json"),
        put(npz_bytes(prediction), "prediction.npz", "application/x-npz"),
    ]
    manifest = {
        "name": payload["name"],
        "version": payload["version"],
        "files": {item.name: {"sha256": item.sha256, "size": item.size} for item in artifacts},
    }
    text = json.dumps(manifest, indent=1, sort_keys=True).encode()
    signer = signing.open_signer(stores.settings)
    with stores.database.session() as session:
        signing.register(session, signer)
    return [
        *artifacts,
        put(text, MANIFEST_NAME, "application/json"),
        put(signer.sign(text), SIGNATURE_NAME, "application/json"),
    ]
