"""Calibrates a twin on a scene's training frames and measures it on the frames that were held out.

Artifacts: ``twin.npz``, ``prediction.npz`` and ``report.json``, see :mod:`workers.tasks.fit_report`.
"""

from __future__ import annotations

from physworld.calibrate import CalibrationConfig, calibrate
from schemas.fit import FitConfig
from workers.context import TaskContext
from workers.lineage import lineage_of
from workers.registry import HandlerResult
from workers.stores import Stores
from workers.tasks.fit_report import MEDIA_TYPES, fit_files, fit_report
from workers.tasks.inputs import scene_of, scene_reference


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
    report = fit_report(scene, fitted)
    artifacts = [
        stores.artifacts.put_bytes(content, name, MEDIA_TYPES[name])
        for name, content in fit_files(scene, fitted, report).items()
    ]
    result = {
        "parameters": report["parameters"],
        "metrics": report["metrics"],
        "artifacts": [artifact.model_dump(mode="json") for artifact in artifacts],
        "seconds": fitted.seconds,
        "lineage": lineage_of([scene_reference(stores, payload["scene_id"])], payload["config"], {}),
    }
    return HandlerResult(result, artifacts[0].sha256)
