"""The search of a calibration: residuals of a twin on the training frames, counted, reported and cancellable.

Steps of the search (a scan, an optimum, a screening, a shift of the points) go through a journal, so that a search
that was killed goes on where it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from physworld.calibrate.journal import Journal
from physworld.calibrate.least_squares import Solution, finite_differences, gauss_newton
from physworld.calibrate.parameters import Parameter
from physworld.errors import CalibrationError, Cancelled, SimulationError
from physworld.scene import UNDEFORMED_AT_REST, Scene
from physworld.twin import Twin

Progress = Callable[[int, int, str], None]

_OFFSET_CLIP_SIGMAS = 3.0
_FIRST_WINDOW = 0.33  # share of the training path that the first search sees
_FIRST_WINDOW_FRAMES = 10
_BESIDE = 0.1  # of a cell: how far beside a point its neighbours are followed
_DISTINCT = 0.05  # starts that end closer than this in the logarithm are one


@dataclass(frozen=True)
class Optimum:
    """Where a descent ended: theta (p,) in the scale of the search, and the mean squared residual there [m^2]."""

    theta: np.ndarray
    cost: float


class Search:
    """Residuals of a twin on the training frames, counted, reported and cancellable."""

    def __init__(
        self,
        scene: Scene,
        twin: Twin,
        max_simulations: int,
        progress: Progress | None,
        cancelled: Callable[[], bool] | None,
        journal: Journal | None = None,
    ) -> None:
        self.scene, self.twin, self.max_simulations = scene, twin, max_simulations
        self.journal = journal or Journal()
        self.progress, self.cancelled = progress, cancelled
        self.simulations, self.limit = 0, max_simulations
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

    def point_of_residual(self) -> np.ndarray:
        """Tracked point of every entry of a residual over all training frames."""
        visible = self.scene.visible[self.begin : self.end]
        points = np.broadcast_to(np.arange(visible.shape[1]), visible.shape)
        return np.repeat(points[visible], 3)

    def twin_at(self, parameters: list[Parameter], theta: np.ndarray) -> Twin:
        twin = self.twin
        for parameter, searched in zip(parameters, theta, strict=True):
            twin = parameter.apply(twin, parameter.value(float(searched)))
        return twin

    def residual(self, parameters: list[Parameter], theta: np.ndarray, end: int | None = None) -> np.ndarray:
        """Predicted minus measured [m] over the training frames up to ``end``, flat.

        NaN where the run blew up or the budget (``limit``) is spent.
        """
        end = self.end if end is None else end
        visible = self.scene.visible[self.begin : end]
        target = self.scene.points[self.begin : end][visible]
        bad = np.full(target.size, np.nan)
        if self.simulations >= self.limit:
            return bad
        self.simulations += 1
        times, controls = self.scene.control_track()
        try:
            twin = self.twin_at(parameters, theta)
            nodes = twin.simulate_nodes(times, controls, self.scene.times[:end], progress=self._poll)
        except SimulationError:
            return bad
        observed = twin.observe(nodes, self.scene.times[:end])
        residual = (observed[self.begin :][visible] - target).reshape(-1)
        loss = float(np.sqrt(np.mean(residual**2)))
        if end == self.end:
            self.history.append(min(loss, self.history[-1]) if self.history else loss)
        if self.progress is not None:
            pairs = zip(parameters, theta, strict=True)
            values = ", ".join(f"{p.name} {p.value(float(t)):.3g}" for p, t in pairs)
            self.progress(self.simulations, self.max_simulations, f"{loss * 1e3:.2f} mm at {values}")
        return residual

    def scan(self, parameters: list[Parameter]) -> Optimum:
        """Multi-start over the starts of the first parameter and of a flow law's, then on all training frames."""
        window = self.first_window()
        tried = [p.start if k == 0 or p.stage == "flow" else p.start[:1] for k, p in enumerate(parameters)]
        starts = [
            np.array([p.searched(value) for p, value in zip(parameters, values, strict=True)])
            for values in product(*tried)
        ]
        costs = self.step(
            "scan",
            lambda: {"costs": [float(np.mean(self.residual(parameters, t, window) ** 2)) for t in starts]},
        )["costs"]
        usable = sorted(
            (cost, tuple(theta)) for cost, theta in zip(costs, starts, strict=True) if cost is not None
        )
        if not usable:
            raise CalibrationError(
                f"none of {len(costs)} starts with {parameters[0].name} from {parameters[0].start[0]:.3g} to "
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
    ) -> Optimum:
        """Gauss-Newton over the frames up to ``end`` (all training frames by default)."""

        def descend() -> dict[str, Any]:
            found = gauss_newton(
                lambda t: self.residual(parameters, t, end),
                theta,
                np.array([p.searched(p.low) for p in parameters]),
                self._high(parameters),
                np.array([p.step for p in parameters]),
                iterations,
            )
            return {"theta": found.theta.tolist(), "cost": found.cost}

        found = self.step("solve " + " ".join(p.name for p in parameters), descend)
        cost = float("nan") if found["cost"] is None else found["cost"]
        return Optimum(np.array(found["theta"]), cost)

    def linearise(self, parameters: list[Parameter], optimum: Optimum) -> Solution | None:
        """Residual and sensitivities at an optimum; None where the budget does not reach."""
        if self.simulations + 1 + len(parameters) > self.limit:
            return None
        now = self.residual(parameters, optimum.theta)
        if not np.isfinite(now).all():
            return None
        jacobian = finite_differences(
            lambda t: self.residual(parameters, t),
            optimum.theta,
            now,
            self._high(parameters),
            np.array([p.step for p in parameters]),
        )
        return Solution(optimum.theta, float(np.mean(now**2)), now, jacobian)

    def screen(
        self, parameters: list[Parameter], optimum: Optimum, candidates: list[Parameter]
    ) -> dict[str, float]:
        """Share of the cost that each candidate can remove beyond the searched ones, to first order.

        One run a candidate gives its effect on the residual; what the searched parameters can do as well is
        projected out. NaN where a run failed or the budget ended.
        """

        def measure() -> dict[str, Any]:
            solution = self.linearise(parameters, optimum)
            if solution is None:
                return {"gains": dict.fromkeys((c.name for c in candidates), float("nan"))}
            basis = np.linalg.qr(solution.jacobian)[0]
            left = solution.residual - basis @ (basis.T @ solution.residual)
            gains = {}
            for candidate in candidates:
                theta = np.append(optimum.theta, _probe(candidate))
                effect = self.residual([*parameters, candidate], theta) - solution.residual
                effect = effect - basis @ (basis.T @ effect)
                along = float(effect @ left)
                helps = candidate.prior != 0.0 or along < 0.0  # drag and friction push one way only
                size = float(effect @ effect) * float(left @ left)
                gains[candidate.name] = along**2 / size if helps and size > 0 else 0.0 * size
            return {"gains": gains}

        found = self.step("screen " + " ".join(c.name for c in candidates), measure)["gains"]
        return {name: float("nan") if gain is None else gain for name, gain in found.items()}

    def shift_points(self, parameters: list[Parameter], theta: np.ndarray) -> bool:
        """Move the tracked points by their mean residual: inside a solid, within a sheet and across it."""
        sigma = self.scene.noise_sigma_m
        lattice = self.twin.lattice
        if self.scene.initial_state != UNDEFORMED_AT_REST or lattice.dim == 1 or not sigma:
            return False
        found = self.step("shift", lambda: {"shift": self._mean_offsets(parameters, theta, sigma)})["shift"]
        if found is None:
            return False
        body, shift = self.twin.body, np.array(found)
        body = replace(
            body, points=body.points + shift[:, : lattice.dim], offsets=body.offsets + shift[:, lattice.dim :]
        )
        self.twin = replace(self.twin, body=body)
        return True

    def _mean_offsets(self, parameters: list[Parameter], theta: np.ndarray, sigma: float) -> list | None:
        """Mean residual of every point in the material's frame [m], (N, 3), clipped; None where it cannot be had."""
        if self.simulations + 2 + len(parameters) > self.limit:
            return None  # the search on the moved points needs a residual and a Jacobian of its own
        twin = self.twin_at(parameters, theta)
        times, controls = self.scene.control_track()
        try:
            nodes = twin.simulate_nodes(
                times, controls, self.scene.times[: self.scene.train[1]], progress=self._poll
            )
        except SimulationError:
            return None
        self.simulations += 1
        frames = slice(self.begin, self.end)
        mask = self.scene.visible[frames]
        error = np.where(mask[..., None], self.scene.points[frames] - twin.track_nodes(nodes)[frames], 0.0)
        gradient = _deformation(twin, nodes)[frames]
        local = np.linalg.solve(gradient, error[..., None])[..., 0]
        seen = np.maximum(mask.sum(axis=0), 1)[:, None]
        limit = _OFFSET_CLIP_SIGMAS * sigma
        return np.clip(local.sum(axis=0) / seen, -limit, limit).tolist()

    def step(self, name: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """A journalled step, which also brings the count of runs and their history to where they were after it."""

        def counted() -> dict[str, Any]:
            found = compute()
            return {**found, "simulations": self.simulations, "history": list(self.history)}

        found = self.journal.step(name, counted)
        self.simulations, self.history = found["simulations"], list(found["history"])
        return found

    @staticmethod
    def _high(parameters: list[Parameter]) -> np.ndarray:
        return np.array([p.searched(p.high) for p in parameters])

    def _poll(self, done: int, total: int) -> None:
        if self.cancelled is not None and self.cancelled():
            raise Cancelled(f"calibration cancelled in run {self.simulations} at frame {done} of {total}")


def _deformation(twin: Twin, carriers: np.ndarray) -> np.ndarray:
    """Where material directions point, (T, N, 3, 3): columns of the deformation gradient; a sheet's normal last.

    Carriers that are particles have no shape functions that last: neighbours of a point are followed instead.
    """
    lattice, points = twin.lattice, twin.body.points
    columns = []
    for axis in range(lattice.dim):
        if twin.formulation == "updated_lagrangian":
            step = np.zeros(lattice.dim)
            step[axis] = _BESIDE * lattice.spacing[axis]
            ends = [
                replace(twin, body=replace(twin.body, points=points + sign * step)).track_nodes(carriers)
                for sign in (-1.0, 1.0)
            ]
            columns.append((ends[1] - ends[0]) / (2.0 * step[axis]))
        else:
            slope = lattice.interpolation(points, tuple(int(a == axis) for a in range(lattice.dim)))
            flat = carriers.transpose(1, 0, 2).reshape(carriers.shape[1], -1)
            columns.append((slope @ flat).reshape(len(points), len(carriers), 3).transpose(1, 0, 2))
    if lattice.dim == 2:
        normal = np.cross(*columns)
        columns.append(normal / np.linalg.norm(normal, axis=-1, keepdims=True))
    return np.stack(columns, axis=-1)


def _probe(candidate: Parameter) -> float:
    """Where a screening tries a candidate: its start, or a few steps beyond a prior that it starts from."""
    searched = candidate.searched(candidate.start[0])
    return searched if candidate.prior == 0.0 else searched + 2 * candidate.step


def _cost(optimum: Optimum) -> float:
    return optimum.cost if np.isfinite(optimum.cost) else float("inf")
