"""Calibrates a twin on a scene's training frames and measures it on the frames that were held out.

Artifacts: ``twin.npz``, ``prediction.npz`` and ``report.json``, see :mod:`workers.tasks.fit_report`. The journal of
the search lies in the data folder until the fit is stored: a killed worker's fit goes on where it was. Simulations that
do not depend on each other are shared with whatever worker is free (:mod:`workers.tasks.shared_runs`).
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

from physworld.calibrate import CalibrationConfig, Journal, calibrate_in_stages
from physworld.errors import PhysworldError
from schemas.fit import FitConfig
from storage import helpers
from workers.context import TaskContext
from workers.errors import Cancelled
from workers.law_choice import chosen_laws
from workers.lineage import lineage_of
from workers.registry import HandlerResult
from workers.stores import Stores
from workers.tasks.fit_accuracy import fit_accuracy, not_measured
from workers.tasks.fit_report import MEDIA_TYPES, fit_files, fit_report
from workers.tasks.inputs import scene_of, scene_reference
from workers.tasks.shared_runs import SharedRunner

JOURNAL = "fit.json"
WORTH_SHARING_S = 0.3  # to hand a simulation to another worker takes some hundredths of a second


def run(context: TaskContext, stores: Stores) -> HandlerResult:
    """Fit, measure, store; what the job's simulations leave in the scratch goes with it."""
    with stores.database.session() as session:
        helpers.call_off(session, context.lease.job_id)  # those of an attempt that was lost
    try:
        made = _fitted(context, stores)
        context.check()
    except (PhysworldError, Cancelled):
        stores.scratch.remove(context.lease.job_id)
        raise
    stores.scratch.remove(context.lease.job_id)
    return made


def _fitted(context: TaskContext, stores: Stores) -> HandlerResult:
    payload = context.lease.payload
    config = FitConfig.model_validate(payload["config"])
    scene = scene_of(stores, payload["scene_id"])

    def progress(done: int, total: int, message: str) -> None:
        context.progress(done, total, "simulations", message)

    calibration = CalibrationConfig(
        particle_budget=config.particle_budget,
        max_simulations=config.max_simulations,
        device=stores.settings.device,
        damping=config.damping,
        plasticity=config.plasticity,
        formulation=config.formulation,
        transfer=config.transfer,
    )
    folder = Path(stores.settings.data_dir) / "checkpoints" / context.lease.job_id
    journal = stored_journal(folder / JOURNAL, payload)
    calibration, law = chosen_laws(config.law, scene, calibration, progress, context.cancelled, journal)
    fitted = calibrate_in_stages(
        scene,
        calibration,
        config.stages,
        progress=progress,
        cancelled=context.cancelled,
        journal=journal,
        runner=SharedRunner(context, stores, WORTH_SHARING_S),
    )
    accuracy = not_measured("left out by the request")
    if config.numerics:

        def measuring(done: int, total: int, message: str) -> None:
            most = max(config.max_simulations, spent + total)
            context.progress(spent + done, most, "simulations", f"numerics: {message}")

        local = fitted.local
        spent = fitted.simulations + (0 if local is None else local.runs + local.simulations)

        accuracy = fit_accuracy(scene, fitted, config.particle_budget, measuring, context.cancelled, journal)
    context.check()
    report = fit_report(scene, fitted, law, accuracy)
    artifacts = [
        stores.artifacts.put_bytes(content, name, MEDIA_TYPES[name])
        for name, content in fit_files(scene, fitted, report).items()
    ]
    result = {
        "parameters": report["parameters"],
        "metrics": {**report["metrics"], "notes": report["notes"]},
        "artifacts": [artifact.model_dump(mode="json") for artifact in artifacts],
        "seconds": fitted.seconds,
        "lineage": lineage_of([scene_reference(stores, payload["scene_id"])], payload["config"], {}),
    }
    shutil.rmtree(folder, ignore_errors=True)
    return HandlerResult(result, artifacts[0].sha256)


def stored_journal(path: Path, payload: dict[str, Any]) -> Journal:
    """The journal of an earlier attempt at the same payload, or an empty one; written at ``path`` after every step."""

    def save(text: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(f".{os.getpid()}")
        partial.write_text(text)
        partial.replace(path)

    stored = path.read_text() if path.exists() else None
    return Journal(json.dumps(payload, sort_keys=True), stored, save)
