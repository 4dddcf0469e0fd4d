"""The search of a calibration: residuals of a twin on the training frames, counted, reported and cancellable.

Steps of the search (a scan, an optimum, a screening, a shift of the points) go through a journal, so that a search
that was killed goes on where it was.

Simulations that do not depend on each other (starts of a scan, columns of a Jacobian, descents side by side) go to a
runner together: in this process one after the other, elsewhere at once. What is found is the same under every runner.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.descents import (
    Descended,
    Descent,
    Optimum,
    Place,
    cost_of,
    in_step,
    measured_together,
)
from physworld.calibrate.parameters import Parameter
from physworld.calibrate.places import misplaced_by
from physworld.calibrate.taut import taut_starts
from physworld.errors import CalibrationError, Cancelled, SimulationError
from physworld.estimation.journal import Journal
from physworld.estimation.least_squares import Descent as LeastSquares
from physworld.estimation.least_squares import Solution, descent, differences, most_runs, probes_of
from physworld.estimation.simulations import Drive, Job, Runner, in_turn
from physworld.estimation.uncertain import mistaken_drives
from physworld.estimation.unknowns import at, bounds_of
from physworld.estimation.whitening import moved, responses
from physworld.scene import UNDEFORMED_AT_REST, Scene
from physworld.twin.twin import Twin

if TYPE_CHECKING:
    from physworld.calibrate.recordings import Agreement

Progress = Callable[[int, int, str], None]

_OFFSET_CLIP_SIGMAS = 3.0
_FIRST_WINDOW = 0.33  # share of the training path that the first search sees
_FIRST_WINDOW_FRAMES = 10
_DISTINCT = 0.05  # starts that end closer than this in the logarithm are one


class Search:
    """Residuals of a twin on the training frames, counted, reported and cancellable.

    Attributes:
        simulations: runs so far.
        limit: how many there may be at the present stage.
        cut_short: whether something was not simulated because the limit was reached: the search did not end by itself.

    Args:
        scene: whose training frames are scored.
        twin: candidates differ from it by what is searched.
        max_simulations: of the whole search.
        progress: called with (done, in all, message).
        cancelled: polled between simulations.
        journal: what was simulated before and is not again.
        runner: of the simulations.

    Raises:
        CalibrationError: no point is visible in the training frames.
    """

    def __init__(
        self,
        scene: Scene,
        twin: Twin,
        max_simulations: int,
        progress: Progress | None,
        cancelled: Callable[[], bool] | None,
        journal: Journal | None = None,
        runner: Runner = in_turn,
    ) -> None:
        self.runner = runner
        self.scene, self.twin, self.max_simulations = scene, twin, max_simulations
        self.journal = journal or Journal()
        self.progress, self.cancelled = progress, cancelled
        self.simulations, self.limit = 0, max_simulations
        self.cut_short = False
        self.history: list[float] = []
        self.begin, self.end = (
            max(scene.train[0], 1),
            scene.train[1],
        )  # frame 0 is the start and is not scored
        if not scene.visible[self.begin : self.end].any():
            raise CalibrationError(f"no visible point in the training frames {scene.train}")

    @property
    def twins(self) -> list[Twin]:
        """What candidates differ from, a twin for every recording."""
        return [self.twin]

    @twins.setter
    def twins(self, twins: list[Twin]) -> None:
        (self.twin,) = twins

    def at(self, parameters: Sequence[Parameter], theta: Array, recording: int = 0) -> Twin:
        """The twin of a recording at a place.

        Args:
            parameters: what is searched (p).
            theta: in the scale of the search, (p,).
            recording: its number.
        """
        return at(self.twin, parameters, theta)

    def first_window(self) -> int:
        """End of the frames in which the points cover the first third of their training path."""
        points, visible = self.scene.points[: self.end], self.scene.visible[: self.end]
        step = np.linalg.norm(np.diff(points, axis=0), axis=2)
        seen = visible[1:] & visible[:-1]
        path = np.cumsum(np.where(seen, step, 0.0).sum(axis=1) / np.maximum(seen.sum(axis=1), 1))
        end = int(np.searchsorted(path, _FIRST_WINDOW * path[-1])) + 2
        return min(max(end, self.begin + _FIRST_WINDOW_FRAMES), self.end)

    def frame_of_residual(self, end: int) -> Array:
        """Frame of every entry of a residual over the frames up to ``end``."""
        visible = self.scene.visible[self.begin : end]
        frames = np.broadcast_to(np.arange(self.begin, end)[:, None], visible.shape)
        return np.repeat(frames[visible], 3)

    def point_of_residual(self) -> Array:
        """Tracked point of every entry of a residual over all training frames."""
        visible = self.scene.visible[self.begin : self.end]
        points = np.broadcast_to(np.arange(visible.shape[1]), visible.shape)
        return np.repeat(points[visible], 3)

    def residual(self, parameters: list[Parameter], theta: Array, end: int | None = None) -> Array:
        """Predicted minus measured [m] over the training frames up to ``end``, flat.

        NaN where the run blew up or the budget (``limit``) is spent.
        """
        return self.residuals([(parameters, theta, end)])[0]

    def residuals(self, places: list[Place]) -> list[Array]:
        """:meth:`residual` at places (parameters, theta, end) that do not depend on each other."""
        allowed = max(0, self.limit - self.simulations)
        self.cut_short |= len(places) > allowed
        found = []
        for place, (residual, loss) in zip(places, self._measured(places[:allowed]), strict=False):
            self.simulations += 1
            if loss is not None:
                self._remember(loss, place[2])
                self.tell(self.simulations, loss, place)
            found.append(residual)
        return [*found, *(self._nothing(end) for _, _, end in places[allowed:])]

    def scan(self, parameters: list[Parameter]) -> Optimum:
        """Multi-start over the starts of the first parameter and of a flow law's, then on all training frames.

        Of a taut rope over those of its section instead (:func:`~physworld.calibrate.taut.taut_starts`), and over the
        others' from the best of these, of which one is kept: what is followed differs in stiffness.
        """
        window = self.first_window()
        taut = any(p.stage == "taut" for p in parameters)
        tried = [p.starts if k == 0 or p.stage == "flow" else p.starts[:1] for k, p in enumerate(parameters)]
        starts = [
            np.array([p.searched(value) for p, value in zip(parameters, values, strict=True)])
            for values in (taut_starts(self.twin, parameters) if taut else product(*tried))
        ]
        usable = self._usable("scan", parameters, starts, window)
        for k, own in enumerate(parameters):
            if usable and taut and own.stage == "flow":
                best, here = np.array(usable[0][1]), np.arange(len(parameters)) == k
                others = [np.where(here, own.searched(value), best) for value in own.starts[1:]]
                usable[0] = min([usable[0], *self._usable(f"scan {own.name}", parameters, others, window)])
        if not usable:
            raise CalibrationError(
                f"none of {len(starts)} starts with {parameters[0].name} from {parameters[0].starts[0]:.3g} to "
                f"{parameters[0].starts[-1]:.3g} {parameters[0].unit} gave a usable simulation"
            )
        early = self.solve_each([Descent(parameters, np.array(theta), 3, window) for _, theta in usable[:3]])
        early.sort(key=cost_of)
        distinct = [
            s for k, s in enumerate(early) if k == 0 or np.abs(s.theta - early[0].theta).max() > _DISTINCT
        ]
        late = min(self.solve_each([Descent(parameters, s.theta, 5) for s in distinct[:2]]), key=cost_of)
        if not (np.isfinite(late.cost) or self.cut_short):
            first = parameters[0]
            raise CalibrationError(
                f"{len(usable)} of {len(starts)} starts gave a usable simulation to frame {window - 1}, the best of "
                f"them none to frame {self.end - 1}, where the training ends: one failed at {first.name} "
                f"{first.value(float(late.theta[0])):.3g} {first.unit}"
            )
        return late

    def _usable(
        self, name: str, parameters: list[Parameter], starts: list[Array], end: int
    ) -> list[tuple[float, tuple[float, ...]]]:
        """Costs and places of the starts whose run can be trusted, the best first; see :meth:`costs`."""
        costs = self.costs(name, parameters, starts, end)
        return sorted((c, tuple(theta)) for c, theta in zip(costs, starts, strict=True) if c is not None)

    def costs(
        self, name: str, parameters: list[Parameter], starts: list[Array], end: int
    ) -> list[float | None]:
        """Mean squared residual [m^2] at every start over the frames up to ``end``; None where the run failed.

        Args:
            name: of the step in the journal.
            parameters: what is searched (p).
            starts: places in the scale of the search, (p,) each.
            end: of the frames that count.
        """

        def measure() -> dict[str, Any]:
            found = self.residuals([(parameters, theta, end) for theta in starts])
            return {"costs": [float(np.mean(residual**2)) for residual in found]}

        costs: list[float | None] = self.step(name, measure)["costs"]
        return costs

    def solve(
        self, parameters: list[Parameter], theta: Array, iterations: int, end: int | None = None
    ) -> Optimum:
        """Gauss-Newton over the frames up to ``end`` (all training frames by default).

        Args:
            parameters: what is searched (p).
            theta: where the descent starts, in the scale of the search, (p,).
            iterations: Jacobians at most.
            end: of the frames that count.
        """
        return self.solve_each([Descent(parameters, theta, iterations, end)])[0]

    def solve_each(self, asked: list[Descent]) -> list[Optimum]:
        """Optima of descents that do not depend on each other, side by side where the runner shares its simulations.

        They are counted one after the other in any case; where the budget might end within them they are also done so.
        """
        together = self._may_share(asked)
        made: dict[int, Descended] = {}
        found = []
        for k, one in enumerate(asked):

            def descend(k: int = k, one: Descent = one) -> dict[str, Any]:
                if k not in made:  # those before it are in the journal
                    several = asked[k:] if together else [one]
                    if not self._may_share(several):
                        ended = self._alone(one)
                        return {"theta": ended.theta.tolist(), "cost": ended.cost}
                    made.update(enumerate(in_step([(self, other) for other in several]), k))
                self.simulations += made[k].runs
                for loss in made[k].losses:
                    self._remember(loss, None)
                return {"theta": made[k].optimum.theta.tolist(), "cost": made[k].optimum.cost}

            kept = self.step("solve " + " ".join(p.name for p in one.parameters), descend)
            cost = float("nan") if kept["cost"] is None else kept["cost"]
            found.append(Optimum(np.array(kept["theta"]), cost))
        return found

    def _may_share(self, several: list[Descent]) -> bool:
        """Whether descents may share a runner: the budget does not end within them, whatever they take."""
        worst = sum(most_runs(len(one.parameters), one.iterations) for one in several)
        return self.runner is not in_turn and self.simulations + worst <= self.limit

    def _alone(self, one: Descent) -> Optimum:
        """A descent whose runs count at once."""
        asking = self.begun(one)
        needed, _ = next(asking)
        while True:
            try:
                needed, _ = asking.send(
                    self.residuals([(one.parameters, theta, one.end) for theta in needed])
                )
            except StopIteration as ended:
                return Optimum(ended.value.theta, ended.value.cost)

    def begun(self, one: Descent) -> LeastSquares:
        """The descent before its first simulation."""
        return descent(one.theta, *bounds_of(one.parameters), _steps(one.parameters), one.iterations)

    def linearise(self, parameters: list[Parameter], optimum: Optimum) -> Solution | None:
        """Residual and sensitivities at an optimum; None where the budget does not reach."""
        if not self._reaches(1 + len(parameters)):
            return None
        probes = probes_of(optimum.theta, bounds_of(parameters)[1], _steps(parameters))
        now, *there = self.residuals([(parameters, theta, None) for theta in (optimum.theta, *probes)])
        if not np.isfinite(now).all():
            return None
        jacobian = differences(optimum.theta, now, _steps(parameters), probes, there)
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
            probed = self.residuals(
                [([*parameters, c], np.append(optimum.theta, _probe(c)), None) for c in candidates]
            )
            for candidate, there in zip(candidates, probed, strict=True):
                effect = there - solution.residual
                effect = effect - basis @ (basis.T @ effect)
                along = float(effect @ left)
                either = candidate.held != 0.0 or candidate.proportional
                helps = either or along < 0.0  # drag and friction push one way only
                size = float(effect @ effect) * float(left @ left)
                gains[candidate.name] = along**2 / size if helps and size > 0 else 0.0 * size
            return {"gains": gains}

        found = self.step("screen " + " ".join(c.name for c in candidates), measure)["gains"]
        return {name: float("nan") if gain is None else gain for name, gain in found.items()}

    def agreement(self, parameters: list[Parameter], solution: Solution) -> tuple[Agreement, ...]:
        """Whether several recordings agree on the object's numbers: of one there is nothing to be said."""
        return ()

    def shift_points(self, parameters: list[Parameter], theta: Array, placed: bool = True) -> bool:
        """Move the tracked points by their mean residual: inside a solid, within a sheet and across it, with a rope's
        sections. Of a start as measured they are moved only if ``placed``, by :mod:`physworld.calibrate.places`."""
        undeformed = self.scene.initial_state == UNDEFORMED_AT_REST
        sigma = self.scene.noise_sigma_m if undeformed else None
        if not (sigma if undeformed else placed):
            return False
        found = self.step("shift", lambda: {"shift": self._offsets(parameters, theta, sigma)})["shift"]
        self.twin = self.twin if found is None else moved(self.twin, np.array(found))
        return found is not None

    def _offsets(
        self, parameters: list[Parameter], theta: Array, sigma: float | None
    ) -> list[list[float]] | None:
        """Of every point in the material's frame [m], (N, 3), clipped at deviations of the noise ``sigma``, or where
        that is None by :func:`misplaced_by`; None where they cannot be had."""
        if not self._reaches(2 + len(parameters)):
            return None  # the search on the moved points needs a residual and a Jacobian of its own
        twin = self.at(parameters, theta)
        frames = self.scene.times[: self.scene.train[1]]
        try:
            nodes = twin.simulate_nodes(*self.scene.control_track(), frames, progress=self._poll)
        except SimulationError:
            return None
        self.simulations += 1
        if sigma is None:
            shifts = misplaced_by(self.scene, twin, nodes)
            return None if shifts is None else list(shifts.tolist())
        own = slice(self.begin, self.end)
        mask = self.scene.visible[own]
        error = np.where(mask[..., None], self.scene.points[own] - twin.track_nodes(nodes)[own], 0.0)
        gradient = (responses if twin.lattice.dim == 1 else material_frames)(twin, nodes)[own]
        local = np.linalg.solve(gradient, error[..., None])[..., 0]
        seen = np.maximum(mask.sum(axis=0), 1)[:, None]
        limit = _OFFSET_CLIP_SIGMAS * sigma
        offsets: list[list[float]] = np.clip(local.sum(axis=0) / seen, -limit, limit).tolist()
        return offsets

    def mistaken(self, parameters: list[Parameter], optimum: Optimum) -> list[Array]:
        """Changes of the residual (m,) [m] by what the scene's controllers may err by, one standard deviation each."""
        drives = mistaken_drives(self.scene)
        if not drives or not self._reaches(len(drives) + 1):
            return []

        def measure() -> dict[str, Any]:
            job = self.job((parameters, optimum.theta, None))
            before, _ = self.compared(job, next(self.run([job])))
            changes = []
            for drive in drives:
                tracks = next(self.runner([job], drive, self._poll))
                changes.append((self.compared(job, tracks)[0] - before).tolist())
            self.simulations += len(drives) + 1
            return {"changes": changes}

        found = [np.array(change) for change in self.step("controllers", measure)["changes"]]
        return [change for change in found if np.isfinite(change).all()]

    def elsewhere(self, twins: list[Twin]) -> list[Array]:
        """Changes of the residual (m,) [m] from the first of some twins to each of the others.

        Args:
            twins: with the numbers that are compared.
        """
        if not twins or not self._reaches(len(twins)):
            return []

        def measure() -> dict[str, Any]:
            jobs = [Job(twin, self.end) for twin in twins]
            first, *others = (
                self.compared(job, tracks)[0] for job, tracks in zip(jobs, self.run(jobs), strict=True)
            )
            self.simulations += len(jobs)
            return {"changes": [(other - first).tolist() for other in others]}

        found = [np.array(change) for change in self.step("elsewhere", measure)["changes"]]
        return [change for change in found if np.isfinite(change).all()]

    def step(self, name: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """A journalled step; the runs, whether any were left out, and their history are brought to where they were."""

        def counted() -> dict[str, Any]:
            found = compute()
            counts = {"simulations": self.simulations, "cut_short": self.cut_short}
            return {**found, **counts, "history": list(self.history)}

        found = self.journal.step(name, counted)
        self.simulations, self.history = found["simulations"], list(found["history"])
        self.cut_short = found["cut_short"]
        return found

    def _reaches(self, runs: int) -> bool:
        """Whether so many runs are left; the search is cut short where they are not."""
        reaches = self.simulations + runs <= self.limit
        self.cut_short |= not reaches
        return reaches

    def _measured(self, places: list[Place]) -> Iterator[tuple[Array, float | None]]:
        """Residuals at places and their root mean squares [m], None where the run failed; nothing is counted."""
        return measured_together([(self, place) for place in places])

    def job(self, place: Place) -> Job:
        """The simulation of a place."""
        parameters, theta, end = place
        return Job(self.at(parameters, theta), self.end if end is None else end)

    def run(self, jobs: list[Job]) -> Iterator[Array | None]:
        """Tracks of simulations under this scene's controls, by the runner."""
        drive = Drive(*self.scene.control_track(), self.scene.times)
        return self.runner(jobs, drive, self._poll) if jobs else iter(())

    def compared(self, job: Job, tracks: Array | None) -> tuple[Array, float | None]:
        """Residual and root mean square [m] of tracks, None where the run failed."""
        if tracks is None:
            return self._nothing(job.frames), None
        visible = self.scene.visible[self.begin : job.frames]
        target = self.scene.points[self.begin : job.frames]
        residual = self.scene.weighed(tracks[self.begin :] - target)[visible].reshape(-1)
        return residual, float(np.sqrt(np.mean(residual**2)))

    def _nothing(self, end: int | None) -> Array:
        """The residual of a run that failed."""
        visible = self.scene.visible[self.begin : self.end if end is None else end]
        return np.full(3 * int(visible.sum()), np.nan)

    def _remember(self, loss: float, end: int | None) -> None:
        if end in (None, self.end):
            self.history.append(min(loss, self.history[-1]) if self.history else loss)

    def tell(self, done: int, loss: float, place: Place) -> None:
        if self.progress is not None:
            pairs = zip(*place[:2], strict=True)
            values = ", ".join(f"{p.name} {p.value(float(t)):.3g}" for p, t in pairs)
            self.progress(done, self.max_simulations, f"{loss * 1e3:.2f} mm at {values}")

    def _poll(self, *frames: int) -> None:
        if self.cancelled is not None and self.cancelled():
            where = "" if not frames else f" at frame {frames[0]} of {frames[1]}"
            raise Cancelled(f"calibration cancelled after {self.simulations} runs{where}")


def _probe(candidate: Parameter) -> float:
    """Where a screening tries a candidate: its start, or a few steps beyond a prior that it starts from."""
    searched = candidate.searched(candidate.starts[0])
    return searched if candidate.held == 0.0 else searched + 2 * candidate.step


def _steps(parameters: list[Parameter]) -> Array:
    return np.array([p.step for p in parameters])


_BESIDE = 0.1  # of a cell: how far beside a point its neighbours are followed


def material_frames(twin: Twin, carriers: Array) -> Array:
    """Where material directions point, (T, N, 3, 3): columns of the deformation gradient; a sheet's normal last.

    Carriers that are particles have no shape functions that last: neighbours of a point are followed instead.
    """
    lattice, points = twin.lattice, twin.body.points
    columns = []
    for axis in range(lattice.dim):
        if twin.form.on_particles:
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
