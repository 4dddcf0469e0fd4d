"""The ``training`` shard: from a dataset to a published world model.

Reads the episodes (``physworld_services.trainer.episodes``), trains with a checkpoint every few hundred steps, kept in
the scratch store (a killed trainer, or another one in its place, carries on from the last one), fine-tunes the
properties on the recording's training frames, measures everything open loop on the frames that were held out, and
stores the version's files. Where a grip lets go in the recording, a model for each other set of grips is trained and
published with the version, and all of them together are measured; nothing is fine-tuned. A version that was asked for a
set of grips has nothing there to be measured by: its card has the validation on the demonstrations.

The files:

* ``model.safetensors``: see ``physworld.worldmodel.model.model`` and ``.published``; ``held_0.safetensors`` …: the same
  of the models for other sets of grips, which ``held`` of the card names;
* ``step.pt2``, ``step.onnx``: one step as a program (``physworld.worldmodel.export``);
* ``card.json``: lineage, architecture, metrics, seeds, versions, intended use, limits;
* ``prediction.npz``: ``times`` (T,) f8 [s], ``tracks`` and ``tracks_calibrated`` (T, N, 3) f4 [m] after and
  before fine-tuning, ``twin_tracks``; ``tick_times`` (S,) f8 and ``vertices`` (S, n, 3) f4 on the model's
  clock;
* ``manifest.json``: sha256 and size of each of them; its digest is the version's;
* ``manifest.sig.json``: the installation's signature of the manifest (``physworld_storage.signing``).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from physworld.demonstrate.config import StrengthRange
from physworld.demonstrate.properties import ranges_of
from physworld.devices import torch_device
from physworld.scene import Scene
from physworld.twin.openings import holding
from physworld.twin.twin import Twin
from physworld.worldmodel.clock import clock_times, model_dt
from physworld.worldmodel.errors import CheckpointMismatch, DatasetUnusable, TrainingCancelled
from physworld.worldmodel.finetune import FineTuneResult, fine_tune
from physworld.worldmodel.holding.rollout import HeldVersions
from physworld.worldmodel.holding.spans import Grips, every_grip, look_ahead_for, sets_of
from physworld.worldmodel.model import config as settings_of
from physworld.worldmodel.model.conditioning import Conditioning
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.published import PublishedModel
from physworld.worldmodel.scene_view import SceneView, view_scene
from physworld.worldmodel.training import TrainingResult, first_episodes, train
from physworld_schemas.base import Reference
from physworld_schemas.model import ModelVersion, TrainingConfig
from physworld_schemas.quality import quality_of
from physworld_services.trainer.closed_loop import closed_loop
from physworld_services.trainer.episodes import Episodes
from physworld_services.trainer.measuring import Measured, json_safe, measure
from physworld_services.trainer.publishing import MANIFEST_NAME, card_of, held_of, model_of, store_version
from physworld_services.trainer.settings import translate
from physworld_storage import registry, traces
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.lineage import lineage_of
from physworld_workers.stores import Stores
from physworld_workers.tasks.dataset import strength_ranges
from physworld_workers.tasks.inputs import made_from, scene_of, twin_of

logger = logging.getLogger(__name__)

CHECKPOINT = "training.pt"
OTHER_GRIPS = (
    "Other grips hold at times in the recording than those that this version learned from, so its error there is not "
    "measured: a version for each set of grips predicts it together (physworld.worldmodel.holding)."
)
DIVERGED = "The training diverged at step {}: the network is that of step {}, the best before."
TWIN_ANSWERS = "The twin is fast itself: it answers rollouts unless the network is asked for."
READING, PRIORS, TRAINING, FINE_TUNING, MEASURING, EXPORTING = (
    "reading the dataset", "fitting the priors", "training", "fine-tuning on the recording",
    "measuring on the held-out frames", "exporting as",
)  # fmt: skip
EXPORT_S = {"torch_export": 3.0, "onnx": 9.0}
Result = TypeVar("Result")


def run(context: TaskContext, stores: Stores) -> HandlerResult:
    """Train, fine-tune, measure, store."""
    payload = context.lease.payload
    config = TrainingConfig.model_validate(payload["config"])
    architecture, training, tuning = translate(config)
    scene = scene_of(stores, payload["scene_id"])
    twin = twin_of(stores, payload["fit_id"], payload.get("trace_id"))
    others = _other_sets(scene, twin) if config.holding is None else []
    context.plan(stages_of(config, others))
    context.begin(READING)
    strengths = _strengths(stores, payload)

    def seen_by(grips: Grips | None) -> tuple[SceneView, Episodes]:
        """The recording and the episodes as a model of these grips sees them; None: of all."""
        view = view_scene(scene, twin, architecture, grips)
        units = {
            f"{one.name}.{part.name}": part.unit for one in twin.effects for part in type(one).strengths(twin)
        }
        friction = None if twin.ground_height_m is None else twin.ground_friction
        facts = (architecture.history, strengths, friction, units, len(view.grips), view.holding)
        return view, Episodes(context, stores, payload["dataset_id"], view.spec, *facts)

    view, episodes = seen_by(None if config.holding is None else tuple(config.holding))
    started = time.perf_counter()
    start = _start(stores, config)
    network = None if start is None else model_of(stores, start).model
    trained = _train(context, stores, episodes, view, architecture, training, network)
    training_s = time.perf_counter() - started
    context.begin(FINE_TUNING, "steps", tuning.steps)
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
            progress=lambda step, steps, loss: context.progress(
                step, steps, "steps", f"fine-tuning, loss {loss:.4g}"
            ),
            cancelled=context.cancelled,
        ),
    )
    tuning_s = time.perf_counter() - started
    covered = {f"{one.effect}.{one.name}": (one.low, one.high) for one in ranges_of(twin, strengths)}
    published = view.published(
        trained.model.at_strengths(tuned.strengths),
        tuned.phi,
        phi,
        Conditioning.of(trained.model, tuned.strengths, covered),
    )
    untuned = trained.model.at_strengths(dict.fromkeys(tuned.strengths, 0.0))
    before = view.published(untuned, phi, phi)
    members: list[PublishedModel] = []
    for grips in others:
        seen, parts = seen_by(grips)
        try:
            own = _train(context, stores, parts, seen, architecture, training, network, grips).model
        except DatasetUnusable as absent:  # no demonstration shows these grips alone
            logger.warning("job %s: %s", context.lease.job_id, absent)
            members = []
            break
        members.append(seen.published(own.at_strengths(dict.fromkeys(tuned.strengths, 0.0)), phi, phi))
    held = HeldVersions.of([published, *members]) if members else None
    context.begin(MEASURING)
    measured = measure(view, published, before, _poll(context, "runs", MEASURING), held)
    seconds = {"training": training_s, "fine_tuning": tuning_s}
    metrics = json_safe(
        _metrics(view, trained, tuned, measured, seconds, view.as_recorded or held is not None)
    )
    if twin.form.fast:
        metrics["predictor"] = "twin"
        metrics["notes"].append(TWIN_ANSWERS)
    metrics["fine_tuning"]["strengths"] = json_safe(episodes.tuned(tuned.strengths))
    metrics["closed_loop"] = json_safe(closed_loop(stores, payload, metrics, architecture))
    dataset = episodes.sealed()
    sources = [dataset, *made_from(stores, payload)]
    if start is not None:
        sources.append(Reference(kind="model", id=str(config.start_from), digest=start.sha256))
    lineage = lineage_of(sources, payload["config"], {"training": config.seed})
    card = card_of(payload, config, published, metrics, lineage) | {"trained_on": episodes.description()}
    card["held"] = held_of(members)
    card["quality"] = quality_of(metrics).model_dump(mode="json")
    begin_export = partial(_begin_export, context)
    artifacts = store_version(stores, payload, published, view, measured, card, begin_export, members)
    manifest = next(artifact for artifact in artifacts if artifact.name == MANIFEST_NAME)
    context.check()
    result = {
        "artifacts": [artifact.model_dump(mode="json") for artifact in artifacts],
        "sha256": manifest.sha256,
        "metrics": metrics,
        "lineage": lineage,
    }
    return HandlerResult(result, manifest.sha256)


def _begin_export(context: TaskContext, name: str) -> None:
    context.begin(f"{EXPORTING} {name}")


def _other_sets(scene: Scene, twin: Twin) -> list[Grips]:
    """Sets of grips that hold in a recording, beside all of them; none where at times nothing holds."""
    if not twin.openings:
        return []
    times = clock_times(float(scene.times[-1] - scene.times[0]), model_dt(scene.fps)) + scene.times[0]
    sets = sets_of(holding(twin, times))
    return [grips for grips in sets if grips != every_grip(len(twin.controller_groups))] if all(sets) else []


def stages_of(config: TrainingConfig, others: Sequence[Grips] = ()) -> dict[str, float]:
    """The stages of a training and about how long each takes [s], of which only the ratios count.

    Medians of the trainings that ``benchmarks.service.time_left`` runs on the sample scene, on a busy machine (ADR 66).
    """
    return {
        READING: 2.0,
        PRIORS: 0.15 * config.vertices,
        TRAINING: 0.0177 * config.hidden * config.steps,
        FINE_TUNING: 0.0042 * config.hidden * config.fine_tune_steps,
        **{
            of_grips(stage, grips): seconds
            for grips in others
            for stage, seconds in (
                (PRIORS, 0.15 * config.vertices),
                (TRAINING, 0.0177 * config.hidden * config.steps),
            )
        },
        MEASURING: 0.5,
        **{f"{EXPORTING} {name}": EXPORT_S[name] for name in config.formats},
    }


def _strengths(stores: Stores, payload: dict[str, Any]) -> tuple[StrengthRange, ...]:
    """Strengths that the dataset's trace found, with their intervals."""
    if payload.get("trace_id") is None:
        return ()
    with stores.database.reading() as session:
        trace = traces.get_trace(session, payload["trace_id"])
    return strength_ranges(trace.effects) if traces.leaves_twin(trace) else ()


def _start(stores: Stores, config: TrainingConfig) -> ModelVersion | None:
    """The version whose network the training goes on from."""
    if config.start_from is None:
        return None
    name, _, number = config.start_from.partition(":")
    with stores.database.reading() as session:
        return registry.get_version(session, name, number)


def _train(
    context: TaskContext,
    stores: Stores,
    episodes: Episodes,
    view: SceneView,
    architecture: settings_of.WorldModelConfig,
    training: settings_of.TrainingConfig,
    start: WorldModel | None,
    grips: Grips | None = None,
) -> TrainingResult:
    """Train, from the checkpoint of an earlier attempt where there is one; ``grips``: for another set of them."""
    job_id = context.lease.job_id
    kept = CHECKPOINT if grips is None else f"grips-{'-'.join(map(str, grips))}-{CHECKPOINT}"
    first = first_episodes(episodes.total, training.start_share)
    tracks = [episodes.tracks(index) for index in range(first)]
    spans = [track for parts in tracks for track in parts]
    if not spans:
        raise DatasetUnusable(
            f"in none of the {first} episodes that the training begins with the grips {list(episodes.grips)}, and no "
            f"other of {episodes.grip_count}, hold for a step or more"
        )
    if episodes.lets_go:
        ahead = look_ahead_for(spans, architecture.history, training.look_ahead)
        training = replace(training, look_ahead=ahead)

    device = torch_device(stores.settings.device)
    logger.info("job %s trains on %s", job_id, device)
    context.begin(of_grips(PRIORS, grips))
    latest: dict[str, float] = {}

    def begin_training() -> None:
        """The priors are fitted once the network is validated for the first time, or trains on from a checkpoint."""
        if not latest:
            context.begin(of_grips(TRAINING, grips), "steps", training.steps)
            episodes.reached = (0, training.steps)

    def progress(step: int, steps: int, loss: float) -> None:
        begin_training()
        episodes.reached = (step, steps)
        latest["loss"] = loss
        context.progress(step, steps, "steps", f"loss {loss:.4g}", latest)

    def validated(step: int, error_m: float) -> None:
        begin_training()
        latest["validation_m"] = error_m
        context.progress(*episodes.reached, "steps", f"validation {1e3 * error_m:.3g} mm", latest)

    def attempt(checkpoint: bytes | None) -> TrainingResult:
        return train(
            tracks,
            view.spec,
            architecture,
            training,
            columns=episodes.columns,
            total=episodes.total,
            later=episodes.tracks,
            checkpoint=checkpoint,
            save_checkpoint=lambda data: stores.scratch.put(job_id, kept, data),
            progress=progress,
            validated=validated,
            cancelled=context.cancelled,
            device=device,
            start=start,
        )

    try:
        return _stopping(context, lambda: attempt(stores.scratch.get(job_id, kept)))
    except CheckpointMismatch as mismatch:
        logger.warning("job %s starts anew: %s", job_id, mismatch)
        return _stopping(context, lambda: attempt(None))


def of_grips(name: str, grips: Grips | None) -> str:
    """A stage of the model for a set of grips that is trained beside the version's own."""
    return name if grips is None else f"{name}, grips {' '.join(map(str, grips))}"


def _poll(context: TaskContext, unit: str, message: str) -> Callable[[int, int], None]:
    """What long work of the library calls between its parts: it reports, and ends the work of a cancelled job."""

    def poll(done: int, of: int) -> None:
        context.check()
        context.progress(done, of, unit, message)

    return poll


def _stopping(context: TaskContext, work: Callable[[], Result]) -> Result:
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
    judged: bool,
) -> dict[str, Any]:
    notes = [] if judged else [OTHER_GRIPS]
    if trained.diverged_at is not None:
        notes.append(DIVERGED.format(trained.diverged_at, trained.best_step))
    return {
        "held_out": measured.table,
        "judged_on_recording": judged,
        "notes": notes,
        "energy": measured.energy,
        "steps_per_second": measured.steps_per_second,
        "predictor": "model",
        "noise_floor_m": measured.table["noise_floor_m"],
        "seconds": seconds,
        "episodes": trained.episodes,
        "validation": {
            "open_loop_m": trained.best_error_m,
            "static_m": trained.static_error_m,
            "prior": trained.prior,
            "prior_m": trained.prior_error_m,
            "priors_m": trained.prior_errors_m,
            "heats_m": trained.heats_m,
            "best_step": trained.best_step,
            "steps": trained.steps,
            "steps_left_out": trained.steps_left_out,
            "diverged_at_step": trained.diverged_at,
            "curve": trained.validation,
            "training_loss": trained.losses,
        },
        "fine_tuning": {
            "kept": tuned.kept,
            "inner_validation_before_m": tuned.error_before_m,
            "inner_validation_after_m": tuned.error_after_m,
            "inner_gain_ci95_m": list(tuned.gain_ci95_m),
            "steps": tuned.steps,
            "phi_rms": float(np.sqrt((tuned.phi**2).mean())),
        },
        "skin_error_m": view.skin_error_m,
        "world_model_against_twin_m": float(
            np.linalg.norm(measured.tracks_calibrated - measured.twin_tracks, axis=2).mean()
        )
        if judged
        else None,
    }
