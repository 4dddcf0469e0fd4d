"""The search of a calibration: residuals of a twin on the training frames, counted, reported and cancellable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from physworld.calibrate.least_squares import Solution, gauss_newton
from physworld.calibrate.parameters import Parameter
from physworld.errors import CalibrationError, Cancelled, SimulationError
from physworld.mpm.lattice import Lattice
from physworld.scene import UNDEFORMED_AT_REST, Scene
from physworld.twin import Twin

Progress = Callable[[int, int, str], None]

_OFFSET_CLIP_SIGMAS = 3.0
_FIRST_WINDOW = 0.33  # share of the training path that the first search sees
_FIRST_WINDOW_FRAMES = 10
_DISTINCT = 0.05  # starts that end closer than this in the logarithm are one


class Search:
    """Residuals of a twin on the training frames, counted, reported and cancellable."""

    def __init__(
        self,
        scene: Scene,
        twin: Twin,
        max_simulations: int,
        progress: Progress | None,
        cancelled: Callable[[], bool] | None,
    ) -> None:
        self.scene, self.twin, self.max_simulations = scene, twin, max_simulations
        self.progress, self.cancelled = progress, cancelled
        self.simulations = 0
        self.history: list[float] = []
        self.begin, self.end = (
            max(scene.train[0], 1),
            scene.train[1],
        )  # frame 0 is the start and is not scored
        if not scene.visible[self.begin : self.end].any():
            raise CalibrationError(f"no visible point in the training frames {scene.train}")

    def first_window(self) -> int:
        """End of the frames in which the points cover the first third of their training path."""
        points, visible = self.scene.points[: self.end], self.scene.visible[: self.end]
        step = np.linalg.norm(np.diff(points, axis=0), axis=2)
        seen = visible[1:] & visible[:-1]
        path = np.cumsum(np.where(seen, step, 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1))
        end = int(np.searchsorted(path, _FIRST_WINDOW * path[-1])) + 2
        return min(max(end, self.begin + _FIRST_WINDOW_FRAMES), self.end)

    def frame_of_residual(self, end: int) -> np.ndarray:
        """Frame of every entry of a residual over the frames up to ``end``."""
        visible = self.scene.visible[self.begin : end]
        frames = np.broadcast_to(np.arange(self.begin, end)[:, None], visible.shape)
        return np.repeat(frames[visible], 3)

    def twin_at(self, parameters: list[Parameter], theta: np.ndarray) -> Twin:
        twin = self.twin
        for parameter, value in zip(parameters, np.exp(theta), strict=True):
            twin = parameter.apply(twin, float(value))
        return twin

    def residual(self, parameters: list[Parameter], theta: np.ndarray, end: int | None = None) -> np.ndarray:
        """Predicted minus measured [m] over the training frames up to ``end``, flat.

        NaN where the run blew up or the budget is spent.
        """
        end = self.end if end is None else end
        visible = self.scene.visible[self.begin : end]
        target = self.scene.points[self.begin : end][visible]
        bad = np.full(target.size, np.nan)
        if self.simulations >= self.max_simulations:
            return bad
        self.simulations += 1
        times, controls = self.scene.control_track()
        try:
            twin = self.twin_at(parameters, theta)
            nodes = twin.simulate_nodes(times, controls, self.scene.times[:end], progress=self._poll)
        except SimulationError:
            return bad
        residual = (twin.track_nodes(nodes)[self.begin :][visible] - target).reshape(-1)
        loss = float(np.sqrt(np.mean(residual**2)))
        if end == self.end:
            self.history.append(min(loss, self.history[-1]) if self.history else loss)
        if self.progress is not None:
            values = ", ".join(f"{p.name} {v:.3g}" for p, v in zip(parameters, np.exp(theta), strict=True))
            self.progress(self.simulations, self.max_simulations, f"{loss * 1e3:.2f} mm at {values}")
        return residual

    def scan(self, parameters: list[Parameter]) -> Solution:
        """Multi-start over the first parameter's starts on the first window, then on all training frames."""
        window = self.first_window()
        rest = [np.log(p.start[0]) for p in parameters[1:]]
        costs = []
        for value in parameters[0].start:
            theta = np.array([np.log(value), *rest])
            costs.append((float(np.mean(self.residual(parameters, theta, window) ** 2)), tuple(theta)))
        usable = sorted(c for c in costs if np.isfinite(c[0]))
        if not usable:
            raise CalibrationError(
                f"none of {len(costs)} starts of {parameters[0].name} from {parameters[0].start[0]:.3g} to "
                f"{parameters[0].start[-1]:.3g} {parameters[0].unit} gave a usable simulation"
            )
        early = [self.solve(parameters, np.array(theta), 3, window) for _, theta in usable[:3]]
        early.sort(key=_cost)
        distinct = [
            s for k, s in enumerate(early) if k == 0 or np.abs(s.theta - early[0].theta).max() > _DISTINCT
        ]
        return min((self.solve(parameters, s.theta, 5) for s in distinct[:2]), key=_cost)

    def solve(
        self, parameters: list[Parameter], theta: np.ndarray, iterations: int, end: int | None = None
    ) -> Solution:
        """Gauss-Newton over the frames up to ``end`` (all training frames by default)."""
        return gauss_newton(
            lambda t: self.residual(parameters, t, end),
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
        if self.simulations + 2 + len(parameters) > self.max_simulations:
            return False  # the search on the moved points needs a residual and a Jacobian of its own
        twin = self.twin_at(parameters, theta)
        times, controls = self.scene.control_track()
        try:
            nodes = twin.simulate_nodes(
                times, controls, self.scene.times[: self.scene.train[1]], progress=self._poll
            )
        except SimulationError:
            return False
        self.simulations += 1
        frames = slice(self.begin, self.end)
        mask = self.scene.visible[frames]
        error = np.where(mask[..., None], self.scene.points[frames] - twin.track_nodes(nodes)[frames], 0.0)
        gradient = _deformation(lattice, twin.body.points, nodes[frames])
        local = np.linalg.solve(gradient, error[..., None])[..., 0]
        seen = np.maximum(mask.sum(axis=0), 1)[:, None]
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


def _cost(solution: Solution) -> float:
    return solution.cost if np.isfinite(solution.cost) else float("inf")
