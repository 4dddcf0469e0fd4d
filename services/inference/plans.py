"""From a request for a plan to its figures and arrays: search with the model, check in the twin.

Arrays of ``plan.npz``, T ticks of the plan after the h + 1 of the model's history:
    times (T,) f8            [s] from the first tick of the history
    controllers (h+1+T, K, 3) f8   all control points [m]; what POST /v1/rollouts takes
    displacements (T, G, 3) f8     of the grips [m]
    predicted (T, N, 3) f4   measured points, the model's [m]
    executed (T, N, 3) f4    the same in the twin [m]
    motionless (T, N, 3) f4  in the twin when the grips do not move [m]
    cost_history (I+1,) f8   best cost after each iteration [m], the first that of grips coming to rest
    goal_index (M,) i8, goal_places (M, 3) f8; or goal_shape (M, 3) f8
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.planning.goals import Goal, GoalPoints, GoalShape
from physworld.planning.mppi import Found, MppiConfig, search
from physworld.planning.task import PlanningTask
from physworld.worldmodel.published import PublishedModel
from physworld_schemas.arrays import FARTHEST_M, array_of
from physworld_schemas.plan import PlanCreate, PlanLimits, PointGoal
from physworld_workers.context import TaskContext
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import scene_of, twin_of

SEARCHING, EXECUTING = "searching a motion", "executing the plan in the twin"
EXECUTED_ITERATIONS = 3.0
"""Iterations of the search that the plan's runs in the twin take as long as, about."""


def make(
    context: TaskContext, stores: Stores, request: PlanCreate, model: PublishedModel
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Search, execute, measure.

    Args:
        context: of the shard: its payload, progress and cancellation.
        stores: hold scene and twin.
        request: goal, limits and settings of the search.
        model: predicts; the twin executes what was found.

    Raises:
        Cancelled: the job was.
        ValueError: the limits leave the start out.
    """
    started = time.perf_counter()
    payload = context.lease.payload
    scene = scene_of(stores, payload["scene_id"])
    twin = twin_of(stores, payload["fit_id"], payload.get("trace_id"))
    task = _limited(PlanningTask.of(model, twin, scene), request.limits)
    goal, goal_arrays = goal_of(request)
    asked = request.config
    config = MppiConfig(
        horizon=asked.horizon, samples=asked.samples, iterations=asked.iterations, settle=asked.settle
    )

    context.plan({SEARCHING: float(config.iterations), EXECUTING: EXECUTED_ITERATIONS})
    context.begin(SEARCHING, "iterations", config.iterations)

    def progress(done: int, total: int, cost: float) -> None:
        context.progress(done, total, "iterations", f"cost {1e3 * cost:.3g} mm")

    found = search(
        task.predict,
        goal,
        task.limits,
        task.dt_s,
        config,
        np.random.default_rng(asked.seed),
        progress=progress,
        cancelled=context.cancelled,
    )
    context.begin(EXECUTING, "runs", 2)
    executed = task.execute(found.displacements)
    context.check()
    context.progress(1, 2, "runs", EXECUTING)
    motionless = task.execute(np.zeros_like(found.displacements))
    arrays = {
        "times": task.dt_s * (np.arange(config.horizon) + len(model.start_history)),
        "controllers": task.controllers(found.displacements),
        "displacements": found.displacements,
        "predicted": found.points.astype(np.float32),
        "executed": executed.astype(np.float32),
        "motionless": motionless.astype(np.float32),
        "cost_history": np.array(found.costs),
        **goal_arrays,
    }
    figures = _figures(task, goal, config, found, executed, motionless)
    return figures | {"goal": request.goal.kind, "seconds": time.perf_counter() - started}, arrays


def goal_of(request: PlanCreate) -> tuple[Goal, dict[str, Array]]:
    """The library's goal, and its arrays by name."""
    if isinstance(request.goal, PointGoal):
        index, places = np.array(request.goal.index), np.array(request.goal.places)
        return GoalPoints(index, places), {"goal_index": index, "goal_places": places}
    shape = array_of(request.goal.shape, "goal.shape", (2,), FARTHEST_M)
    return GoalShape(shape), {"goal_shape": shape}


def _limited(task: PlanningTask, limits: PlanLimits) -> PlanningTask:
    def corner(place: tuple[float, float, float] | None) -> Array | None:
        return None if place is None else np.array(place)

    return task.with_limits(
        limits.speed_m_s,
        limits.acceleration_m_s2,
        corner(limits.workspace_min_m),
        corner(limits.workspace_max_m),
    )


def _figures(
    task: PlanningTask,
    goal: Goal,
    config: MppiConfig,
    found: Found,
    executed: Array,
    motionless: Array,
) -> dict[str, Any]:
    ending = slice(-config.settling, None)
    gap = np.linalg.norm(found.points - executed, axis=-1)
    speeds = np.linalg.norm(np.diff(found.displacements, axis=0, prepend=0.0), axis=-1) / task.dt_s
    limits = task.limits
    return {
        "dt_s": task.dt_s,
        "history": len(task.model.start_history) - 1,
        "predicted_error_m": found.distance_m,
        "executed_error_m": float(goal.distance(executed[ending]).mean()),
        "motionless_error_m": float(goal.distance(motionless[ending]).mean()),
        "model_against_twin_m": float(gap.mean()),
        "model_against_twin_end_m": float(gap[ending].mean()),
        "cost_history": list(found.costs),
        "limits": {
            "speed_m_s": limits.speed_m_s,
            "acceleration_m_s2": limits.acceleration_m_s2,
            "workspace_min_m": limits.box_min_m.tolist(),
            "workspace_max_m": limits.box_max_m.tolist(),
        },
        "peak_speed_m_s": float(speeds.max()),
        "samples": found.samples,
    }
