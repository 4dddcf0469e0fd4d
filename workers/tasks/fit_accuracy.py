"""How far a fit's figures are the engine's own: its numerics on the scene, and its numbers with cells of no size.

The same for the service's task and for ``physworld fit``. A body whose numerics cannot be measured keeps its fit; the
record says why it has none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from physworld.calibrate import FitResult, Journal
from physworld.calibrate.discretisation import converged_parameters
from physworld.calibrate.search import Progress
from physworld.errors import Cancelled, SceneUnsupported, SimulationError
from physworld.estimation.simulations import Runner, in_turn
from physworld.evaluate.numerics import measure_numerics, refined_tracks_of
from physworld.scene import Scene
from physworld_schemas.wording import reason
from physworld_workers.tasks.fit_report import json_safe, parameter_json

MEASURED_RUNS = 4


def fit_accuracy(
    scene: Scene,
    fitted: FitResult,
    particle_budget: int,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    journal: Journal | None = None,
    runner: Runner = in_turn,
) -> dict[str, Any]:
    """``numerics``, ``converged`` and ``not_measured`` (why one is null, else empty), as plain JSON.

    Args:
        scene: the recording.
        fitted: its calibration.
        particle_budget: the one that it was made with.
        progress: called with (runs done, runs in all, what comes next).
        cancelled: polled every frame of every run.
        journal: keeps what was measured for a later attempt.
        runner: where runs go that do not depend on each other.

    Raises:
        Cancelled: ``cancelled`` returned true.
    """
    return (journal or Journal()).step(
        "accuracy", lambda: _measured(scene, fitted, particle_budget, progress, cancelled, runner)
    )


def not_measured(reason: str) -> dict[str, Any]:
    """The record of a fit whose accuracy was not measured."""
    return {"numerics": None, "converged": None, "not_measured": reason}


def _measured(
    scene: Scene,
    fitted: FitResult,
    budget: int,
    progress: Progress | None,
    cancelled: Callable[[], bool] | None,
    runner: Runner,
) -> dict[str, Any]:
    if not fitted.twin.lattice.smooth:
        return not_measured(f"{fitted.twin.lattice.title} has no finer cells to be asked")
    if fitted.twin.openings:
        return not_measured("grips let go in the recording: what work they do is not kept")
    none = _not_extrapolated(fitted)
    total = MEASURED_RUNS + (0 if none else len(fitted.searched))

    def poll(done: int, frames: int) -> None:
        if cancelled is not None and cancelled():
            raise Cancelled(f"numerics cancelled at frame {done} of {frames}")

    def tell(done: int, _: int, message: str) -> None:
        if progress is not None:
            progress(done, total, "sensitivities" if done == MEASURED_RUNS else message)

    try:
        tell(0, total, "half the time step and finer cells")
        finer = refined_tracks_of(scene, fitted.twin, budget, poll=poll, runner=runner)
        numerics = measure_numerics(
            scene, fitted.twin, particle_budget=budget, progress=tell, poll=poll, refined_tracks=finer
        )
        if none:
            return {**not_measured(none), "numerics": json_safe(asdict(numerics))}
        converged = converged_parameters(
            scene, fitted, budget, poll=poll, runner=runner, finer_tracks=finer.finer_cells
        )
    except (SimulationError, SceneUnsupported) as error:  # finer cells may not hold what these do
        return not_measured(reason(error))
    return {
        "numerics": json_safe(asdict(numerics)),
        "converged": {name: parameter_json(estimate) for name, estimate in converged.items()},
        "not_measured": "",
    }


def _not_extrapolated(fitted: FitResult) -> str:
    """Why there are no numbers with cells of no size, empty where there are."""
    if fitted.twin.form.on_particles:
        return "converged: numbers with cells of no size are found in the total Lagrangian form"
    if fitted.cut_short:
        return "converged: the budget of simulations cut the search short, there is no optimum to extrapolate"
    return ""
