"""Checks what a scene's motion can show; its simulations are shared with whatever worker is free.

Every simulation is kept in the job's scratch folder under its fingerprint, so that a check whose worker was killed goes
on where it was.
"""

from __future__ import annotations

from typing import Any

from physworld.calibrate import CalibrationConfig
from physworld.check import CheckConfig, check, document
from physworld.report import names
from physworld_schemas.check import CheckConfig as WireConfig
from physworld_storage.jobs import helpers
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.lineage import lineage_of
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import scene_of, scene_reference
from physworld_workers.tasks.shared_runs import SharedMemory, SharedRunner

WORTH_S = 0.3
"""A simulation that takes less is not worth what sharing it costs."""


def run(context: TaskContext, stores: Stores) -> HandlerResult:
    """Check, report."""
    payload = context.lease.payload
    with stores.database.session() as session:
        helpers.call_off(session, context.lease.job_id)  # those of an attempt that was lost
    result = check(
        scene_of(stores, payload["scene_id"]),
        translate(WireConfig.model_validate(payload["config"]), stores.settings.device),
        runner=SharedRunner(context, stores, WORTH_S),
        memory=SharedMemory(stores, context.lease.job_id),
        progress=lambda done, total, stage: context.progress(done, total, "simulations", stage),
        cancelled=context.cancelled,
    )
    context.check()
    inputs = [scene_reference(stores, payload["scene_id"])]
    made_by = lineage_of(inputs, {"check": payload["config"]}, {"check": payload["config"]["seed"]})
    return HandlerResult({"report": worded(document(result)), "lineage": made_by})


def worded(report: dict[str, Any]) -> dict[str, Any]:
    """The document of a check whose proposal calls effects as people do; its lists keep their names in the registry."""
    proposal = report["proposal"]
    if proposal is not None:
        fields = {
            label for change in (*proposal["shows"], *proposal["separates"]) for label in change["labels"]
        }
        proposal["description"] = names.reworded(proposal["description"], fields)
    return report


def translate(config: WireConfig, device: str) -> CheckConfig:
    """The wire's settings as the library's."""
    return CheckConfig(
        calibration=CalibrationConfig(particle_budget=config.particle_budget, device=device),
        noise_m=config.noise_m,
        discrepancy_share=config.discrepancy_share,
        values=config.values,
        candidates=tuple(config.candidates),
        motions=config.motions,
        seed=config.seed,
    )
