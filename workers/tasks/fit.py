"""Calibrates a twin on a scene's training frames and measures it on the frames that were held out.

Artifacts: ``twin.npz`` (the twin, see ``Twin.to_arrays``), ``prediction.npz`` (``times`` (T,) f8 [s],
``tracks`` (T, N, 3) f4 [m], ``particles`` (T, P', 3) f4 [m] with P' at most 1500, ``particle_indices``
(P',)), ``report.json`` (parameters, metrics, notes).
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from physworld.calibrate import CalibrationConfig, FitResult, calibrate
from physworld.evaluate.table import held_out_table
from schemas.base import Artifact
from schemas.fit import FitConfig, Parameter
from workers.context import TaskContext
from workers.lineage import lineage_of
from workers.registry import HandlerResult
from workers.stores import Stores
from workers.tasks.inputs import TWIN, npz_bytes, scene_of, scene_reference

PREDICTION = "prediction.npz"
REPORT = "report.json"
SHOWN_PARTICLES = 1500


def run(context: TaskContext, stores: Stores) -> HandlerResult:
    """Fit, measure, store."""
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
    )
    fitted = calibrate(scene, calibration, progress=progress, cancelled=context.cancelled)
    context.check()
    parameters = {name: _parameter(estimate) for name, estimate in fitted.parameters.items()}
    metrics = _json_safe(
        {
            "held_out": held_out_table(scene, {"twin": fitted.tracks}),
            "simulations": fitted.simulations,
            "seconds": fitted.seconds,
            "training_loss_m": fitted.loss_history,
            "not_needed": fitted.rejected,
            "particles": fitted.particles.shape[1],
        }
    )
    notes = list(fitted.twin.body.notes)
    artifacts = _store(
        stores, scene.times, fitted, {"parameters": parameters, "metrics": metrics, "notes": notes}
    )
    result = {
        "parameters": parameters,
        "metrics": metrics,
        "artifacts": [artifact.model_dump(mode="json") for artifact in artifacts],
        "seconds": fitted.seconds,
        "lineage": lineage_of([scene_reference(stores, payload["scene_id"])], payload["config"], {}),
    }
    return HandlerResult(result, artifacts[0].sha256)


def _store(stores: Stores, times: np.ndarray, fitted: FitResult, report: dict[str, Any]) -> list[Artifact]:
    count = fitted.particles.shape[1]
    shown = np.unique(np.linspace(0, count - 1, min(count, SHOWN_PARTICLES)).round().astype(np.int64))
    prediction = {
        "times": times,
        "tracks": fitted.tracks.astype(np.float32),
        "particles": fitted.particles[:, shown].astype(np.float32),
        "particle_indices": shown,
    }
    put = stores.artifacts.put_bytes
    return [
        put(npz_bytes(fitted.twin.to_arrays()), TWIN, "application/x-npz"),
        put(npz_bytes(prediction), PREDICTION, "application/x-npz"),
        put(json.dumps(report, indent=1, allow_nan=False).encode(), REPORT, "application/json"),
    ]


def _parameter(estimate: Any) -> dict[str, Any]:
    interval = estimate.ci95
    if interval is not None and not all(math.isfinite(end) for end in interval):
        interval = None
    parameter = Parameter(
        value=estimate.value,
        unit=estimate.unit,
        ci95=interval,
        identified=estimate.identified,
        note=estimate.note,
    )
    return parameter.model_dump(mode="json")


def _json_safe(value: Any) -> Any:
    """Plain JSON types; a number that is not finite becomes None (a run that blew up has no loss)."""
    if isinstance(value, dict):
        return {str(key): _json_safe(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_json_safe(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
