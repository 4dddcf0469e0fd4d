"""Global stage: homogeneous parameters of a twin, fitted to the training frames of a recording.

1. Scan the stiffness over its decades (multi-start: the cost has local minima where phases slip).
2. Gauss-Newton on the stiffness parameters from the two best starts.
3. Add air drag and internal friction, the better one first, each only if it lowers the training cost by more
   than 2 %.
4. Shift the tracked points inside the body by their mean residual (frame 0 is noisy too), clipped at 3 sigma.
5. Gauss-Newton again on all that were kept; intervals from blocks of frames.

Only training frames enter. The simulation's budget counts every run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from physworld.calibrate.least_squares import Solution, block_covariance, gauss_newton, interval_factor
from physworld.calibrate.parameters import Parameter, parameters_of
from physworld.errors import CalibrationError, Cancelled, SimulationError
from physworld.mpm.lattice import Lattice
from physworld.scene import UNDEFORMED_AT_REST, Scene
from physworld.twin import Twin, build_twin

Progress = Callable[[int, int, str], None]

_DAMPING_GAIN = 0.02  # share of the training cost that a damping parameter must remove
_UNIDENTIFIED_LOG_WIDTH = (
    1.5  # half width of a 95 % interval in the logarithm beyond which a value is not known
)
_OFFSET_CLIP_SIGMAS = 3.0


@dataclass(frozen=True)
class CalibrationConfig:
    """Settings of the global stage.

    Attributes:
        particle_budget: about how many particles a solid gets.
        max_simulations: at most this many runs over the training frames.
        damping: "auto" adds drag and internal friction where the data ask; "none" keeps the declared physics only.
    """

    particle_budget: int = 2000
    max_simulations: int = 80
    damping: str = "auto"


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
    search = _Search(scene, build_twin(scene, config.particle_budget), config, progress, cancelled)
    separate = scene.body.thickness_m is None and scene.body.size_m is None
    parameters = parameters_of(search.twin, separate)
    stiffness = [p for p in parameters if p.stage == "stiffness"]
    solution = search.scan(stiffness)
    kept, rejected = list(stiffness), {}
    candidates = [p for p in parameters if p.stage == "damping"] if config.damping == "auto" else []
    while candidates:
        trials = [
            search.solve(
                [*kept, c], np.append(solution.theta, np.log(c.start[0])), 4 if len(candidates) > 1 else 3
            )
            for c in candidates
        ]
        best = int(np.argmin([t.cost for t in trials]))
        gain = 1.0 - trials[best].cost / solution.cost
        if gain <= _DAMPING_GAIN:
            rejected.update(
                {c.name: 1.0 - t.cost / solution.cost for c, t in zip(candidates, trials, strict=True)}
            )
            break
        kept, solution = [*kept, candidates.pop(best)], trials[best]
    if search.shift_points(kept, solution.theta):
        solution = search.solve(kept, solution.theta, 3)
    twin = search.twin_at(kept, solution.theta)
    times, controls = scene.control_track()
    nodes = twin.simulate_nodes(times, controls, scene.times)
    return FitResult(
        twin=twin,
        parameters={**_estimates(kept, solution, search.frame_of_residual), **_priors(scene, twin, rejected)},
        tracks=twin.track_nodes(nodes),
        particles=twin.particles_at(nodes),
        simulations=search.simulations,
        seconds=time.perf_counter() - started,
        loss_history=search.history,
        rejected=rejected,
    )


class _Search:
    """Residuals of a twin on the training frames, counted, reported and cancellable."""

    def __init__(
        self,
        scene: Scene,
        twin: Twin,
        config: CalibrationConfig,
        progress: Progress | None,
        cancelled: Callable[[], bool] | None,
    ) -> None:
        self.scene, self.twin, self.config = scene, twin, config
        self.progress, self.cancelled = progress, cancelled
        self.simulations = 0
        self.history: list[float] = []
        begin, end = scene.train
        self.frames = slice(max(begin, 1), end)  # frame 0 is the start and is not scored
        visible = scene.visible[self.frames]
        self.mask = visible
        self.target = scene.points[self.frames][visible]
        frame = np.arange(self.frames.start, end)[:, None] * np.ones(visible.shape[1], dtype=int)
        self.frame_of_residual = np.repeat(frame[visible], 3)
        if len(self.target) == 0:
            raise CalibrationError(f"no visible point in the training frames {scene.train}")

    def twin_at(self, parameters: list[Parameter], theta: np.ndarray) -> Twin:
        twin = self.twin
        for parameter, value in zip(parameters, np.exp(theta), strict=True):
            twin = parameter.apply(twin, float(value))
        return twin

    def residual(self, parameters: list[Parameter], theta: np.ndarray) -> np.ndarray:
        """Predicted minus measured [m], flat; NaN where the run blew up or the budget is spent."""
        bad = np.full(3 * len(self.target), np.nan)
        if self.simulations >= self.config.max_simulations:
            return bad
        self.simulations += 1
        end = self.scene.train[1]
        times, controls = self.scene.control_track()
        try:
            twin = self.twin_at(parameters, theta)
            nodes = twin.simulate_nodes(times, controls, self.scene.times[:end], progress=self._poll)
        except SimulationError:
            return bad
        residual = (twin.track_nodes(nodes)[self.frames][self.mask] - self.target).reshape(-1)
        loss = float(np.sqrt(np.mean(residual**2)))
        self.history.append(min(loss, self.history[-1]) if self.history else loss)
        if self.progress is not None:
            values = ", ".join(f"{p.name} {v:.3g}" for p, v in zip(parameters, np.exp(theta), strict=True))
            self.progress(self.simulations, self.config.max_simulations, f"{loss * 1e3:.2f} mm at {values}")
        return residual

    def scan(self, parameters: list[Parameter]) -> Solution:
        """Multi-start over the first parameter's starts, then Gauss-Newton from the best two."""
        rest = [np.log(p.start[0]) for p in parameters[1:]]
        costs = []
        for value in parameters[0].start:
            theta = np.array([np.log(value), *rest])
            costs.append((float(np.mean(self.residual(parameters, theta) ** 2)), tuple(theta)))
        usable = sorted(c for c in costs if np.isfinite(c[0]))
        if not usable:
            raise CalibrationError(
                f"none of {len(costs)} starts of {parameters[0].name} from {parameters[0].start[0]:.3g} to "
                f"{parameters[0].start[-1]:.3g} {parameters[0].unit} gave a usable simulation"
            )
        return min(
            (self.solve(parameters, np.array(theta), 5) for _, theta in usable[:2]), key=lambda s: s.cost
        )

    def solve(self, parameters: list[Parameter], theta: np.ndarray, iterations: int) -> Solution:
        return gauss_newton(
            lambda t: self.residual(parameters, t),
            theta,
            np.log([p.low for p in parameters]),
            np.log([p.high for p in parameters]),
            np.array([p.step for p in parameters]),
            iterations,
        )

    def shift_points(self, parameters: list[Parameter], theta: np.ndarray) -> bool:
        """Move the tracked points inside the body by their mean residual, in the material's frame (solids)."""
        sigma = self.scene.noise_sigma_m
        lattice = self.twin.lattice
        if self.scene.initial_state != UNDEFORMED_AT_REST or lattice.dim != 3 or not sigma:
            return False
        twin = self.twin_at(parameters, theta)
        times, controls = self.scene.control_track()
        try:
            nodes = twin.simulate_nodes(
                times, controls, self.scene.times[: self.scene.train[1]], progress=self._poll
            )
        except SimulationError:
            return False
        self.simulations += 1
        error = np.where(
            self.mask[..., None], self.scene.points[self.frames] - twin.track_nodes(nodes)[self.frames], 0
        )
        gradient = _deformation(lattice, twin.body.points, nodes[self.frames])
        local = np.linalg.solve(gradient, error[..., None])[..., 0]
        seen = np.maximum(self.mask.sum(axis=0), 1)[:, None]
        limit = _OFFSET_CLIP_SIGMAS * sigma
        shift = np.clip(local.sum(axis=0) / seen, -limit, limit)
        self.twin = replace(self.twin, body=replace(self.twin.body, points=twin.body.points + shift))
        return True

    def _poll(self, done: int, total: int) -> None:
        if self.cancelled is not None and self.cancelled():
            raise Cancelled(f"calibration cancelled in run {self.simulations} at frame {done} of {total}")


def _deformation(lattice: Lattice, points: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Deformation gradients at material points, (T, N, 3, 3)."""
    frames = nodes.shape[0]
    flat = nodes.transpose(1, 0, 2).reshape(nodes.shape[1], -1)
    columns = []
    for axis in range(3):
        slope = lattice.interpolation(points, tuple(int(a == axis) for a in range(3)))
        columns.append((slope @ flat).reshape(len(points), frames, 3).transpose(1, 0, 2))
    return np.stack(columns, axis=-1)


def _estimates(parameters: list[Parameter], solution: Solution, frames: np.ndarray) -> dict[str, Estimate]:
    covariance = block_covariance(solution, frames)
    found = {}
    for k, parameter in enumerate(parameters):
        value = float(np.exp(solution.theta[k]))
        half = interval_factor() * float(np.sqrt(max(covariance[k, k], 0.0)))
        insensitive = not np.any(solution.jacobian[:, k])
        at_bound = not (parameter.low * 1.01 < value < parameter.high * 0.99)
        identified = half < _UNIDENTIFIED_LOG_WIDTH and not at_bound and not insensitive
        note = "" if identified else "at the bound of its search" if at_bound else "the data do not fix it"
        interval = (
            (value * float(np.exp(-min(half, 50))), value * float(np.exp(min(half, 50))))
            if half > 0
            else None
        )
        found[parameter.name] = Estimate(value, parameter.unit, interval, identified, note)
    return found


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
        held[name] = Estimate(
            0.0, "", None, False, f"not needed: removes {max(gain, 0.0):.1%} of the training cost"
        )
    return held
