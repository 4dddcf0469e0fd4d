"""Calibrates a twin on a scene's training frames and measures it on the frames that were held out.

Of several recordings of one object (``scene_ids``) all are fitted together; a law is chosen by the first, and the
numerics are measured on it.

Artifacts: ``twin.npz``, ``prediction.npz`` and ``report.json``, see :mod:`physworld_workers.tasks.fit_report`. The
journal of the search lies in the job's scratch folder: a killed worker's fit goes on where it was, on any host.
Simulations that do not depend on each other are shared with whatever worker is free
(:mod:`physworld_workers.tasks.shared_runs`).
"""

from __future__ import annotations

from physworld.calibrate import CalibrationConfig, calibrate_in_stages
from physworld.engine.thin.triangles import Mesh
from physworld_schemas.fit import FitConfig
from physworld_storage.jobs import helpers
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.law_choice import chosen_laws
from physworld_workers.lineage import lineage_of
from physworld_workers.stores import Stores
from physworld_workers.tasks.fit_accuracy import fit_accuracy, not_measured
from physworld_workers.tasks.fit_report import fit_files, fit_report, media_type
from physworld_workers.tasks.inputs import scene_of, scene_reference
from physworld_workers.tasks.shared_runs import SharedRunner, stored_journal

SEARCH, NUMERICS = "calibrating", "measuring the numerics"
USUAL_SIMULATIONS, NUMERICS_SIMULATIONS = 70.0, 20.0
"""With how many simulations searches end, whatever their budget; and how many of these the numerics take as long as.

The sample's search ends with 60, those of the other recordings in ``docs/measured.md`` with 46 to 167, of 400.
"""
WORTH_SHARING_S = 0.3  # to hand a simulation to another worker takes some hundredths of a second


def run(context: TaskContext, stores: Stores) -> HandlerResult:
    """Fit, measure, store."""
    with stores.database.session() as session:
        helpers.call_off(session, context.lease.job_id)  # those of an attempt that was lost
    payload = context.lease.payload
    config = FitConfig.model_validate(payload["config"])
    scene_ids = [payload["scene_id"], *payload.get("scene_ids", ())]
    scenes = [scene_of(stores, known) for known in scene_ids]
    scene = scenes[0]

    usual = min(USUAL_SIMULATIONS, config.max_simulations)
    context.plan({SEARCH: usual, NUMERICS: NUMERICS_SIMULATIONS if config.numerics else 0.0})
    context.begin(SEARCH, "simulations", config.max_simulations, usual)

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
        mesh=None if config.mesh is None else Mesh.read(config.mesh),
    )
    journal = stored_journal(stores, context.lease.job_id, payload)
    runner = SharedRunner(context, stores, WORTH_SHARING_S)
    calibration, law = chosen_laws(
        config.law, scene, calibration, progress, context.cancelled, journal, runner
    )
    fitted = calibrate_in_stages(
        scenes,
        calibration,
        config.stages,
        None,
        progress,
        context.cancelled,
        journal,
        runner,
    )
    accuracy = not_measured("left out by the request")
    if config.numerics:

        def measuring(done: int, total: int, message: str) -> None:
            context.progress(done, total, "runs", f"{NUMERICS}: {message}")

        context.begin(NUMERICS, "runs")
        accuracy = fit_accuracy(
            scene, fitted, config.particle_budget, measuring, context.cancelled, journal, runner
        )
    context.check()
    report = fit_report(scene, fitted, law, accuracy)
    artifacts = [
        stores.artifacts.put_bytes(content, name, media_type(name))
        for name, content in fit_files(scene, fitted, report).items()
    ]
    result = {
        "parameters": report["parameters"],
        "metrics": {**report["metrics"], "notes": report["notes"]},
        "artifacts": [artifact.model_dump(mode="json") for artifact in artifacts],
        "seconds": fitted.seconds,
        "lineage": lineage_of([scene_reference(stores, known) for known in scene_ids], payload["config"], {}),
    }
    context.check()
    return HandlerResult(result, artifacts[0].sha256)
