"""Global stage: homogeneous parameters of a twin, fitted to the training frames of a recording.

1. Scan the stiffness over its decades on a first window of frames, where phases have not slipped yet, and follow the
   three best starts there by Gauss-Newton.
2. Gauss-Newton on all training frames from the two best.
3. Add air drag and internal friction, the better one first, each only if it lowers the training cost by more
   than 2 %; drop again what the others made needless.
4. Shift the tracked points inside the body by their mean residual (frame 0 is noisy too), clipped at 3 sigma.
5. Gauss-Newton again on all that were kept; intervals from blocks of frames.

Only training frames enter. The simulation's budget counts every run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from physworld.calibrate.least_squares import Solution, block_covariance, interval_factor
from physworld.calibrate.parameters import Parameter, parameters_of
from physworld.calibrate.search import Progress, Search
from physworld.scene import Scene
from physworld.twin import Twin, build_twin

_DAMPING_GAIN = 0.02  # share of the training cost that a damping parameter must remove
_UNIDENTIFIED_LOG_WIDTH = (
    1.5  # half width of a 95 % interval in the logarithm beyond which a value is not known
)


@dataclass(frozen=True)
class CalibrationConfig:
    """Settings of the global stage.

    Attributes:
        particle_budget: about how many particles a solid gets.
        max_simulations: at most this many runs over the training frames.
        device: Warp device of the simulations.
        damping: "auto" adds drag and internal friction where the data ask; "none" keeps the declared physics only.
    """

    particle_budget: int = 2000
    max_simulations: int = 160
    device: str = "cpu"
    damping: Literal["auto", "none"] = "auto"


@dataclass(frozen=True)
class Estimate:
    """A calibrated number: value, unit, 95 % interval (None where none can be given), and whether data fix it."""

    value: float
    unit: str
    ci95: tuple[float, float] | None = None
    identified: bool = True
    note: str = ""


@dataclass(frozen=True)
class FitResult:
    """What a calibration found.

    Attributes:
        twin: with the calibrated parameters.
        parameters: estimates by name.
        tracks: tracked points over all frames, open loop from the first, (T, N, 3) [m].
        particles: particles over all frames, (T, P, 3) [m].
        simulations: runs used.
        seconds: wall time.
        loss_history: root mean squared training residual after each run [m], best so far.
        rejected: parameters that were tried and not kept, with the share of the cost that they removed.
    """

    twin: Twin
    parameters: dict[str, Estimate]
    tracks: np.ndarray
    particles: np.ndarray
    simulations: int
    seconds: float
    loss_history: list[float]
    rejected: dict[str, float] = field(default_factory=dict)


def calibrate(
    scene: Scene,
    config: CalibrationConfig | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> FitResult:
    """Fit a twin to the training frames of ``scene``.

    Args:
        scene: the recording.
        config: settings; None for the defaults.
        progress: called with (runs done, runs at most, message).
        cancelled: polled every frame of every run.

    Raises:
        CalibrationError: no start gave a usable simulation.
        Cancelled: ``cancelled`` returned true.
        SceneUnsupported: the scene declares too little for a body.
    """
    config = config or CalibrationConfig()
    started = time.perf_counter()
    search = Search(
        scene,
        build_twin(scene, config.particle_budget, config.device),
        config.max_simulations,
        progress,
        cancelled,
    )
    separate = scene.body.thickness_m is None and scene.body.size_m is None
    parameters = parameters_of(search.twin, separate)
    stiffness = [p for p in parameters if p.stage == "stiffness"]
    solution = search.scan(stiffness)
    kept, rejected = list(stiffness), {}
    candidates = [p for p in parameters if p.stage == "damping"] if config.damping == "auto" else []
    while candidates:
        trials = [
            search.solve([*kept, c], np.append(solution.theta, np.log(c.start[0])), 4) for c in candidates
        ]
        costs = [t.cost if np.isfinite(t.cost) else np.inf for t in trials]  # not a number: the budget ended
        best = int(np.argmin(costs))
        if not costs[best] < (1.0 - _DAMPING_GAIN) * solution.cost:
            rejected.update(
                {c.name: 1.0 - t.cost / solution.cost for c, t in zip(candidates, trials, strict=True)}
            )
            break
        kept, solution = [*kept, candidates.pop(best)], trials[best]
    for needless in [p for p in kept if p.stage == "damping"]:
        others = [k for k, p in enumerate(kept) if p is not needless]
        trial = search.solve([kept[k] for k in others], solution.theta[others], 2)
        if trial.cost * (1.0 - _DAMPING_GAIN) <= solution.cost:
            rejected[needless.name] = 1.0 - solution.cost / trial.cost
            kept, solution = [kept[k] for k in others], trial
    if search.shift_points(kept, solution.theta):
        solution = search.solve(kept, solution.theta, 3)
    twin = search.twin_at(kept, solution.theta)
    times, controls = scene.control_track()
    nodes = twin.simulate_nodes(times, controls, scene.times)
    return FitResult(
        twin=twin,
        parameters={
            **_estimates(kept, solution, search.frame_of_residual(search.end)),
            **_priors(scene, twin, rejected),
        },
        tracks=twin.track_nodes(nodes),
        particles=twin.particles_at(nodes),
        simulations=search.simulations,
        seconds=time.perf_counter() - started,
        loss_history=search.history,
        rejected=rejected,
    )


def _estimates(parameters: list[Parameter], solution: Solution, frames: np.ndarray) -> dict[str, Estimate]:
    covariance = block_covariance(solution, frames)
    factor = interval_factor(len(np.unique(frames)), len(parameters))
    found = {}
    for k, parameter in enumerate(parameters):
        value = float(np.exp(solution.theta[k]))
        half = factor * float(np.sqrt(covariance[k, k])) if covariance[k, k] > 0 else float("inf")
        insensitive = not np.any(solution.jacobian[:, k])
        at_bound = not (parameter.low * 1.01 < value < parameter.high * 0.99)
        identified = half < _UNIDENTIFIED_LOG_WIDTH and not at_bound and not insensitive
        note = "" if identified else _why_not_identified(at_bound, insensitive)
        interval = (
            (value * float(np.exp(-min(half, 50))), value * float(np.exp(min(half, 50))))
            if np.isfinite(half)
            else None
        )
        found[parameter.name] = Estimate(value, parameter.unit, interval, identified, note)
    return found


def _why_not_identified(at_bound: bool, insensitive: bool) -> str:
    if insensitive:
        return "its sensitivity was not measured: the budget of simulations ended first"
    return "at the bound of its search" if at_bound else "the data do not fix it"


def _priors(scene: Scene, twin: Twin, rejected: dict[str, float]) -> dict[str, Estimate]:
    """What was held: the density (only ratios to it show), Poisson's ratio, and damping that was not needed."""
    unit = {3: "kg/m^3", 2: "kg/m^2", 1: "kg/m"}[twin.lattice.dim]
    declared = scene.body.density_kg_m3 is not None or scene.body.mass_kg is not None
    note = "as declared" if declared else "prior"
    held = {
        "density": Estimate(
            twin.density, unit, None, False, f"{note}; only stiffness over density shows in the motion"
        )
    }
    for name, value in twin.parameters.items():
        if name == "poissons_ratio":
            held[name] = Estimate(value, "1", None, False, "held at its prior")
        elif name == "stretching_n":
            held[name] = Estimate(
                value, "N", None, False, "held: stiff enough to stretch by less than a percent"
            )
    for name, gain in rejected.items():
        share = (
            f"removes {max(gain, 0.0):.1%} of the training cost"
            if np.isfinite(gain)
            else "not tried to its end"
        )
        held[name] = Estimate(0.0, "", None, False, f"not needed: {share}")
    return held
