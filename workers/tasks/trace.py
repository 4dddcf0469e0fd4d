"""Traces a scene's residual to a named effect; its simulations are shared with whatever worker is free.

One ``trace`` shard, the driver, does all that decides. Simulations that do not depend on each other are put up as
``simulation`` shards of the same job, which other workers take from the queue and the driver takes itself
(``physworld_storage.jobs.helpers``). Every simulation is kept in the job's scratch folder under its fingerprint, and so
is the calibration's journal: a trace whose worker was killed goes on where it was, on any host.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.calibrate import CalibrationConfig
from physworld.calibrate.parameters import bending_ratio
from physworld.engine.thin.triangles import Mesh
from physworld.materials.sheet import SheetLaw
from physworld.scene import UNDEFORMED_AT_REST
from physworld.trace import TraceConfig, trace
from physworld.trace.recordings import placed_in
from physworld.twin.twin import Twin
from physworld_schemas.base import Reference
from physworld_schemas.fit import FitConfig
from physworld_schemas.trace import TraceConfig as WireConfig
from physworld_storage import resources
from physworld_storage.jobs import helpers
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.lineage import lineage_of
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import fit_reference, scene_of, scene_reference, twin_of
from physworld_workers.tasks.shared_runs import SharedMemory, SharedRunner, stored_journal
from physworld_workers.tasks.trace_report import trace_files, trace_report

if TYPE_CHECKING:
    from physworld.scene import Scene

_PLATE = 1e-6  # relative difference to a homogeneous plate of the declared thickness that is rounding
_STAGES = (  # of a trace, with the share of its work that is done when one begins
    ("declared physics", 0.35),
    ("numerics", 0.4),
    ("fit with", 0.55),
    ("held-out", 0.9),
    ("experiment", 0.92),
)


def run(context: TaskContext, stores: Stores) -> HandlerResult:
    """Trace, report, store."""
    payload = context.lease.payload
    scene = scene_of(stores, payload["scene_id"])
    others = [*payload.get("scene_ids", ()), *payload.get("held_out_scene_ids", ())]
    with stores.database.session() as session:
        helpers.call_off(session, context.lease.job_id)  # those of an attempt that was lost
    result = _traced(context, stores, scene)
    context.check()
    report = trace_report(result)
    artifacts = [
        stores.artifacts.put_bytes(content, name, media_type)
        for name, media_type, content in trace_files(scene, result, report)
    ]
    inputs: list[Reference] = [scene_reference(stores, known) for known in (payload["scene_id"], *others)]
    if payload["fit_id"] is not None:
        inputs.append(fit_reference(stores, payload["fit_id"]))
    settings = {"fit": payload["fit"], "trace": payload["trace"]}
    found = {
        "verdict": report["verdict"],
        "report": report,
        "artifacts": [artifact.model_dump(mode="json") for artifact in artifacts],
        "lineage": lineage_of(inputs, settings, {"trace": payload["trace"]["seed"]}),
    }
    context.check()
    return HandlerResult(found, artifacts[0].sha256)


def _traced(context: TaskContext, stores: Stores, scene: Scene) -> Any:
    payload = context.lease.payload
    fit = FitConfig.model_validate(payload["fit"])
    shown = _Progress(context, fit.max_simulations)
    return trace(
        [scene, *(scene_of(stores, known) for known in payload.get("scene_ids", ()))],
        translate(fit, WireConfig.model_validate(payload["trace"]), stores.settings.device),
        held_out=[scene_of(stores, known) for known in payload.get("held_out_scene_ids", ())],
        runner=SharedRunner(context, stores),
        memory=SharedMemory(stores, context.lease.job_id),
        journal=stored_journal(stores, context.lease.job_id, payload),
        calibrated_twin=_undamped_twin(stores, payload["fit_id"], fit, payload["scene_id"]),
        progress=shown,
        cancelled=context.cancelled,
    )


def translate(fit: FitConfig, config: WireConfig, device: str) -> TraceConfig:
    """The wire's settings as the library's."""
    settings = TraceConfig()
    calibration = CalibrationConfig(
        particle_budget=fit.particle_budget,
        max_simulations=fit.max_simulations,
        device=device,
        damping="none",
        mesh=None if fit.mesh is None else Mesh.read(fit.mesh),
    )
    return replace(
        settings,
        calibration=calibration,
        candidates=tuple(config.candidates),
        effects_at_most=config.effects_at_most,
        confirmed=config.confirmed,
        iterations=config.iterations,
        bootstraps=config.resamples,
        time_limit_s=config.time_limit_s,
        noise_m=config.noise_m,
        seed=config.seed,
    )


class _Progress:
    """A trace's own progress, in percent: how many simulations it takes is open until it ends."""

    def __init__(self, context: TaskContext, calibration_runs: int) -> None:
        self._context, self._runs, self._share = context, calibration_runs, 0.0

    def __call__(self, done: int, total: int, message: str) -> None:
        begun = next((share for stage, share in _STAGES if message.startswith(stage)), None)
        if begun is None and total:
            begun = _STAGES[0][1] * min(1.0, done / max(total, self._runs))
        self._share = max(self._share, begun or 0.0)
        text = f"{message}, {done} simulations" if message else f"{done} simulations"
        self._context.progress(round(100 * self._share, 1), 100, "percent", text)


def _undamped_twin(stores: Stores, fit_id: str | None, asked: FitConfig, scene_id: str) -> Twin | None:
    """The fit's twin where its physics is the declared one and its cells are those asked for; else None.

    A sheet whose bending has a shape of its own is none: an effect such as fibres may have gone into it. Of a fit of
    another recording, or of a start as measured, the parameters are taken, in a body that stands where the traced
    scene starts and has its points where the first frame says.
    """
    if fit_id is None:
        return None
    with stores.database.reading() as session:
        fit = resources.get_fit(session, fit_id)
    config = fit.config
    cells = (config.particle_budget, config.mesh)
    if cells != (asked.particle_budget, asked.mesh) or not config.usual_physics:
        return None
    twin = twin_of(stores, fit_id)
    if isinstance(twin.law, SheetLaw):
        shape = (twin.law.bending_coupling, bending_ratio(twin))
        if not np.allclose(shape, 1.0, rtol=_PLATE):
            return None
    damped = re.compile("drag|viscosity|relaxation")
    if any(value for name, value in twin.parameters.items() if damped.search(name)):
        return None
    scene = scene_of(stores, scene_id)
    if fit.scene_id == scene_id and scene.initial_state == UNDEFORMED_AT_REST:
        return twin
    return placed_in(scene, twin, asked.particle_budget)
