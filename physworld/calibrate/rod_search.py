"""The search of a discrete rod's calibration: launches of twins side by side, and Gauss-Newton with priors on them.

:mod:`physworld.calibrate.rods` says what is minimised and over which windows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.parameters import Parameter
from physworld.calibrate.rod_parameters import GRAVITY
from physworld.engine.rods.discrete_rods import DiscreteRods
from physworld.errors import Cancelled, SimulationError
from physworld.estimation.least_squares import damped_step
from physworld.estimation.unknowns import at, bounds_of
from physworld.scene import Scene
from physworld.twin.rods import driven_at, shapes
from physworld.twin.twin import Twin

if TYPE_CHECKING:
    from physworld.calibrate.recordings import Agreement

Progress = Callable[[int, int, str], None]

_WINDOWS = (0.17, 0.43, 0.71, 1.0)
_DAMPINGS = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
_LONGEST_STEP = 1.0
_ENOUGH, _SETTLED = 1e-4, 3e-3  # relative falls of the cost: what counts, and what is worth another Jacobian
_CORRELATED = 2.0  # times sqrt(L / g)
_SIGMA_SHARE = 0.005  # of the length: what a rod leaves before anything is known


@dataclass
class RodSearch:
    """Launches of one calibration, and what they have to explain.

    Attributes:
        scene: the recording.
        twin: of a discrete rod; what is launched differs from it by its numbers.
        limit: launches at most.
        progress: called with (launches done, launches at most, message).
        cancelled: polled before every launch.
        simulations: launches done.
        cut_short: something was left out for want of launches.
    """

    scene: Scene
    twin: Twin
    limit: int
    progress: Progress | None = None
    cancelled: Callable[[], bool] | None = None
    simulations: int = 0
    cut_short: bool = False

    def __post_init__(self) -> None:
        times, controls = self.scene.control_track()
        self.end = self.scene.train[1]
        self.run = self.twin.integration(times, controls, self.scene.times[: self.end])
        self.shapes = shapes(self.twin)
        self.history: list[float] = []
        length = float(self.twin.lattice.particle_measures.sum())
        self.sigma = max(self.scene.noise_sigma_m or 0.0, _SIGMA_SHARE * length)
        step = float(np.median(np.diff(self.scene.times)))
        self.together = max(1.0, _CORRELATED * float(np.sqrt(length / GRAVITY)) / step)

    @property
    def windows(self) -> list[int]:
        """The frame after the last one of every window: of a body that is driven from inside since the first step."""
        drive = self.twin.drive
        still = 0 if drive is None else int(np.searchsorted(self.scene.times, drive[0, 0]))
        return [max(4, still + round(share * (self.end - still))) for share in _WINDOWS]

    @property
    def left(self) -> Any:
        """What the model leaves of a residual, one deviation [m]: plain JSON, to be kept and set again."""
        return self.sigma

    @left.setter
    def left(self, left: Any) -> None:
        self.sigma = left

    def settle(self, unknowns: Sequence[Parameter], theta: Array, end: int) -> None:
        """Take what the model leaves at ``theta`` (p,) over the frames up to ``end``, the noise at least."""
        residual = self.launched(unknowns, [theta], end)[0]
        if residual is not None:
            self.sigma = max(self.scene.noise_sigma_m or 0.0, float(np.sqrt(np.mean(residual**2))), 1e-9)

    def tracks(self, twins: Sequence[Twin], end: int) -> list[Array | None]:
        """Tracked points (end, N, 3) of twins in one launch; None where the run cannot be trusted."""
        if self.cancelled is not None and self.cancelled():
            raise Cancelled(f"calibration cancelled after {self.simulations} runs")
        run, base = self.run, self.run.problem
        assert base.sections is not None
        frames = run.frame_index[:end]
        knots = max(2, int(frames.max()) + 1)
        problems = [
            replace(
                base,
                law=twin.law,
                drag_per_s=twin.air_drag_per_s,
                stiffness_factor=None if twin.properties is None else np.exp(twin.properties[:, 0]),
                density_factor=None if twin.properties is None else np.exp(twin.properties[:, 1]),
                sections=replace(
                    base.sections,
                    natural=self.shapes @ twin.natural,
                    driven=driven_at(twin.drive, run.knots[:knots]),
                    turns=base.sections.turns[:knots],
                ),
            )
            for twin in twins
        ]
        held = replace(run.held, positions=run.held.positions[:knots], velocities=run.held.velocities[:knots])
        self.simulations += 1
        rods = self._solver(problems)
        found = rods.run(self.twin.body.start, run.velocity, [held], run.knots[:knots])
        cut = replace(run, frame_index=frames)
        return [
            None
            if isinstance(nodes, SimulationError)
            else self.twin.track_nodes(cut.at_frames(self.twin.body.start, nodes))
            for nodes in found
        ]

    def _solver(self, problems: list[Any]) -> DiscreteRods:
        if len(problems) == 1 or not problems[0].terms:
            return DiscreteRods(problems)
        return _InTurn(problems)

    def residuals(self, twins: Sequence[Twin], end: int) -> list[Array | None]:
        """Residuals [m] of the visible points over the frames up to ``end``, frame 0 left out."""
        mask = self.scene.visible[1:end]
        target = self.scene.points[1:end]
        return [
            None if tracks is None else self.scene.weighed(tracks[1:] - target)[mask].ravel()
            for tracks in self.tracks(twins, end)
        ]

    def launched(
        self, unknowns: Sequence[Parameter], places: Sequence[Array], end: int
    ) -> list[Array | None]:
        """Residuals [m] at places (p,) over the frames up to ``end``: see :meth:`residuals`."""
        return self.residuals([at(self.twin, unknowns, place) for place in places], end)

    def reaches(self, launches: int) -> bool:
        """Whether so many launches are left; the search is cut short where they are not."""
        reaches = self.simulations + launches <= self.limit
        self.cut_short |= not reaches
        return reaches

    def tell(self, unknowns: Sequence[Parameter], theta: Array, rms: float) -> None:
        self.history.append(rms)
        if self.progress is not None:
            shown = ", ".join(
                f"{p.name} {p.value(float(t)):.3g}" for p, t in list(zip(unknowns, theta, strict=True))[:3]
            )
            self.progress(self.simulations, self.limit, f"{1e3 * rms:.2f} mm at {shown}")

    def descend(
        self, unknowns: Sequence[Parameter], theta: Array, end: int, steps: int
    ) -> tuple[Array, float]:
        """Gauss-Newton with priors over the frames up to ``end``: where it ends, and the cost there.

        Args:
            unknowns: with their priors and bounds.
            theta: where it begins, in the unknowns' transforms, (p,).
            end: the frame after the last one.
            steps: at most.
        """
        cost = np.inf
        for _ in range(steps):
            if not self.reaches(2):
                break
            residual, jacobian = self.linearised(unknowns, theta, end)
            if residual is None or jacobian is None:
                break
            off, prior = off_priors(unknowns, theta)
            cost = self.cost(residual, off)
            weight = 1.0 / (self.sigma**2 * self.together)
            normal = weight * jacobian.T @ jacobian + np.diag(prior**2)
            gradient = weight * jacobian.T @ residual + prior * off
            trials = [
                np.clip(theta + damped_step(normal, gradient, damping, _LONGEST_STEP), *bounds_of(unknowns))
                for damping in _DAMPINGS
            ]
            costs = [
                np.inf if found is None else self.cost(found, off_priors(unknowns, trial)[0])
                for trial, found in zip(trials, self.launched(unknowns, trials, end), strict=True)
            ]
            best = int(np.argmin(costs))
            if not costs[best] < cost * (1.0 - _ENOUGH):
                break
            settled = costs[best] > cost * (1.0 - _SETTLED)
            theta, cost = trials[best], float(costs[best])
            self.tell(unknowns, theta, self.rms(residual, end))
            if settled:
                break
        return theta, cost

    def linearised(
        self, unknowns: Sequence[Parameter], theta: Array, end: int
    ) -> tuple[Array | None, Array | None]:
        """Residual (m,) and sensitivities (m, p) at theta; None where a run failed."""
        places = [theta] + [theta + np.eye(len(theta))[k] * u.step for k, u in enumerate(unknowns)]
        now, *there = self.launched(unknowns, places, end)
        if now is None:
            return None, None
        columns = [
            np.zeros_like(now) if one is None else (one - now) / u.step
            for one, u in zip(there, unknowns, strict=True)
        ]
        return now, np.stack(columns, axis=1)

    def rms(self, residual: Array, end: int) -> float:
        """Root mean square [m] of residuals (m,) over the frames up to ``end``."""
        return float(np.sqrt(np.mean(residual**2)))

    def agreement(
        self, unknowns: Sequence[Parameter], theta: Array, residual: Array, jacobian: Array
    ) -> tuple[Agreement, ...]:
        """Whether several recordings agree on the object's numbers: of one there is nothing to be said.

        Args:
            unknowns: what was searched (p).
            theta: the optimum, (p,).
            residual: there, over all training frames, (m,).
            jacobian: its sensitivities, (m, p).
        """
        return ()

    def cost(self, residual: Array, off: Array) -> float:
        """Of residuals (m,) and of what the unknowns are off their priors (p,)."""
        return float(residual @ residual) / (self.sigma**2 * self.together) + float(off @ off)


class _InTurn(DiscreteRods):
    """Copies whose terms have memory run one after the other."""

    def __init__(self, problems: list[Any]) -> None:
        self._each = [DiscreteRods([problem]) for problem in problems]

    def run(self, x: Array, v: Array, held: Any, times: Array, progress: Any = None) -> list[Any]:
        """See the base class.

        Args:
            x, v, held, times, progress: as there.
        """
        return [each.run(x, v, held, times, progress)[0] for each in self._each]


def off_priors(unknowns: Sequence[Parameter], theta: Array) -> tuple[Array, Array]:
    """Distances from the priors in their deviations (p,), and one over the deviations."""
    known = [u.prior for u in unknowns]
    means = np.array([p[0] for p in known if p is not None])
    inverse = np.array([1.0 / p[1] for p in known if p is not None])
    return (theta - means) * inverse, inverse
