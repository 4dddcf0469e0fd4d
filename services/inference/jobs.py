"""The ``rollout`` and ``plan`` shards of the ``infer`` queue.

Files: ``rollout.npz`` with ``times`` (S,) f8 [s] and, as asked for, ``points`` (B, S, N, 3) and ``vertices``
(B, S, n, 3) f4 [m]; ``plan.npz`` as ``physworld_services.inference.plans`` says.
"""

from __future__ import annotations

from typing import Any

from physworld_schemas.base import Reference
from physworld_schemas.plan import PlanCreate
from physworld_schemas.rollout import RolloutCreate
from physworld_services.inference import rollouts
from physworld_services.inference.models import Models
from physworld_storage import registry
from physworld_storage.runs import RESULT
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.lineage import lineage_of
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import made_from, npz_bytes, scene_of, twin_of

NPZ = "application/vnd.numpy.npz"


def rollout(context: TaskContext, stores: Stores) -> HandlerResult:
    """Predict every candidate, by the network or by the twin; the answer lies in ``rollout.npz``."""
    payload = context.lease.payload
    asked = RolloutCreate.model_validate_json(stores.artifacts.read_bytes(payload["request"]))
    version, model = models_of(stores).get(payload["model"], payload["version"])
    prepared = rollouts.prepare(asked, model)
    context.progress(0, prepared.steps, "steps")

    def progress(done: int, total: int) -> None:
        context.check()
        context.progress(done, total, "steps")

    made_of: list[dict[str, Any]] = []
    if asked.by == "twin":
        from physworld_services.inference import twin_rollouts

        own = {"scene_id": version.scene_id, "fit_id": version.fit_id, "trace_id": version.trace_id}
        made_of = [item.model_dump(mode="json") for item in made_from(stores, own)]
        twin = twin_of(stores, str(version.fit_id), version.trace_id)
        scene = scene_of(stores, str(version.scene_id))
        arrays, seconds = twin_rollouts.run(asked, model, prepared, twin, scene, progress=progress)
    else:
        arrays, seconds = rollouts.run(asked, model, prepared, progress=progress)
    content = npz_bytes({"times": prepared.times, **arrays})
    made = stores.artifacts.put_bytes(content, RESULT["rollout"], NPZ)
    figures = {**rollouts.facts(asked, model, prepared), "seconds": seconds, "sha256": version.sha256}
    artifacts = [made.model_dump(mode="json")]
    return _result(payload, figures, artifacts, version.sha256, {}, made.sha256, made_of)


def plan(context: TaskContext, stores: Stores) -> HandlerResult:
    """Search a motion, execute it in the twin, say how far both end from the goal."""
    from physworld_services.inference.plans import make

    payload = context.lease.payload
    asked = PlanCreate.model_validate_json(stores.artifacts.read_bytes(payload["request"]))
    version, model = models_of(stores).get(payload["model"], payload["version"])
    figures, arrays = make(context, stores, asked, model)
    made = stores.artifacts.put_bytes(npz_bytes(arrays), RESULT["plan"], NPZ)
    inputs = [item.model_dump(mode="json") for item in made_from(stores, payload)]
    seeds = {"plan": asked.config.seed}
    return _result(
        payload, figures, [made.model_dump(mode="json")], version.sha256, seeds, made.sha256, inputs
    )


def models_of(stores: Stores) -> Models:
    """The models of this process."""
    return stores.cached("models", lambda: Models(stores.database, stores.artifacts))


def _result(
    payload: dict[str, Any],
    figures: dict[str, Any],
    artifacts: list[dict[str, Any]],
    sha256: str | None,
    seeds: dict[str, int],
    digest: str,
    more: list[dict[str, Any]] | None = None,
) -> HandlerResult:
    model_id = registry.reference_id(payload["model"], payload["version"])
    inputs = [Reference(kind="model", id=model_id, digest=sha256)]
    inputs += [Reference.model_validate(item) for item in more or []]
    lineage = lineage_of(inputs, {"request": payload["request"]}, seeds)
    return HandlerResult({"figures": figures, "artifacts": artifacts, "lineage": lineage}, digest)
