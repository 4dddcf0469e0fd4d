"""Calibration of discrete rods: all of a rod's numbers at once, each with a prior, over windows of frames that grow.

    minimise  sum r^2 / (n_c sigma^2)  +  sum ((theta - mean) / deviation)^2

r are the residuals of the tracked points on the training frames. sigma is what the model leaves of them, found as it
goes on (the tracking noise at least); neighbouring frames err alike, so that n_c of them, those within 2 sqrt(L / g),
count as one. Nothing is selected: a number that the data do not ask for stays near its prior, and the report says so.

1. Stiffness, internal friction and drag from several starts, over the first frames.
2. All unknowns, Gauss-Newton, over 17, 43, 71 and 100 % of the training frames (of a body that is driven from inside,
   since the first step): a window that grows finds the basin that all frames at once miss. All frames again as long as
   sigma falls.

A launch integrates a twin and what differs from it by one step in each number, side by side; it is counted as one
simulation. Priors: curvature of its own as of a coil of some windings, torsion of a round section, air drag of ropes
and foam rods in air, friction and creep small.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.estimates import (
    RATIO_NOTE,
    UNIDENTIFIED_HALF_WIDTH,
    Correlations,
    Estimate,
    training_losses,
)
from physworld.calibrate.parameters import Parameter
from physworld.calibrate.rod_parameters import DRIVE, GRAVITY, LOSSES, rod_parameters, steps_seen
from physworld.engine.rods.discrete_rods import DiscreteRods
from physworld.errors import CalibrationError, Cancelled, SimulationError
from physworld.estimation.journal import Journal
from physworld.estimation.least_squares import correlations
from physworld.estimation.unknowns import LINEAR, at
from physworld.scene import Scene
from physworld.twin.rods import driven_at, shapes
from physworld.twin.twin import Twin

if TYPE_CHECKING:
    from physworld.calibrate.global_stage import CalibrationConfig, FitResult

Progress = Callable[[int, int, str], None]

_WINDOWS = (0.17, 0.43, 0.71, 1.0)
_STARTS = (5e-4, 2e-3, 8e-3, 3e-2, 0.2, 1.5)  # of rho A g L^3: bending stiffnesses that hang visibly
_STIFF_STARTS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)  # of what rings by itself: denser, for its phase
_FIRST = ("bending_n_m2", "relaxation_s", "air_drag_per_s")
_FIRST_STEPS, _STEPS = 5, 8
_DAMPINGS = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
_LONGEST_STEP = 1.0
_AGAIN, _STEADY = (
    6,
    0.95,
)  # descents on all frames while what is left of them still falls to less than this share
_ENOUGH, _SETTLED = 1e-4, 3e-3  # relative falls of the cost: what counts, and what is worth another Jacobian
_CORRELATED = 2.0  # times sqrt(L / g)
_SIGMA_SHARE = 0.005  # of the length: what a rod leaves before anything is known
_Z95 = 1.96


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
            off, prior = _prior(unknowns, theta)
            cost = self.cost(residual, off)
            weight = 1.0 / (self.sigma**2 * self.together)
            normal = weight * jacobian.T @ jacobian + np.diag(prior**2)
            gradient = weight * jacobian.T @ residual + prior * off
            trials = []
            for damping in _DAMPINGS:
                step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
                trials.append(_within(unknowns, theta + np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)))
            costs = [
                np.inf if found is None else self.cost(found, _prior(unknowns, trial)[0])
                for trial, found in zip(
                    trials, self.residuals([at(self.twin, unknowns, t) for t in trials], end), strict=True
                )
            ]
            best = int(np.argmin(costs))
            if not costs[best] < cost * (1.0 - _ENOUGH):
                break
            settled = costs[best] > cost * (1.0 - _SETTLED)
            theta, cost = trials[best], float(costs[best])
            self.tell(unknowns, theta, float(np.sqrt(np.mean(residual**2))))
            if settled:
                break
        return theta, cost

    def linearised(
        self, unknowns: Sequence[Parameter], theta: Array, end: int
    ) -> tuple[Array | None, Array | None]:
        """Residual (m,) and sensitivities (m, p) at theta; None where a run failed."""
        places = [theta] + [theta + np.eye(len(theta))[k] * u.step for k, u in enumerate(unknowns)]
        now, *there = self.residuals([at(self.twin, unknowns, place) for place in places], end)
        if now is None:
            return None, None
        columns = [
            np.zeros_like(now) if one is None else (one - now) / u.step
            for one, u in zip(there, unknowns, strict=True)
        ]
        return now, np.stack(columns, axis=1)

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


def calibrate_rod(
    scene: Scene,
    twin: Twin,
    config: CalibrationConfig,
    progress: Progress | None,
    cancelled: Callable[[], bool] | None,
    journal: Journal | None,
) -> FitResult:
    """Fit a discrete rod to the training frames of ``scene``; see the module's text.

    Args:
        scene: the recording.
        twin: with prior numbers.
        config: settings; ``max_simulations`` counts launches, ``damping`` "none" frees no friction, drag or creep.
        progress: called with (launches done, launches at most, message).
        cancelled: polled before every launch.
        journal: finished steps of an earlier attempt.

    Raises:
        CalibrationError: no start gave a usable simulation.
        Cancelled: ``cancelled`` returned true.
    """
    from physworld.calibrate.global_stage import FitResult

    begun = time.perf_counter()
    search = RodSearch(scene, twin, config.max_simulations, progress, cancelled)
    journal = journal or Journal()
    if twin.drive is None:
        twin = search.twin = replace(twin, drive=steps_seen(scene))
    unknowns = rod_parameters(scene, twin)
    held = (*config.held, *(LOSSES if config.damping == "none" else ()))
    unknowns = [u for u in unknowns if not u.name.startswith(held)]
    still = 0 if twin.drive is None else int(np.searchsorted(scene.times, twin.drive[0, 0]))
    ends = [max(4, still + round(share * (search.end - still))) for share in _WINDOWS]

    def step(name: str, compute: Callable[[], tuple[Array, float]]) -> tuple[Array, float]:
        def counted() -> dict[str, Any]:
            theta, cost = compute()
            return {"theta": theta.tolist(), "cost": cost, "simulations": search.simulations, "sigma": search.sigma,
                    "history": list(search.history), "cut_short": search.cut_short}  # fmt: skip

        kept = journal.step(name, counted)
        search.simulations, search.sigma = kept["simulations"], kept["sigma"]
        search.history, search.cut_short = list(kept["history"]), kept["cut_short"]
        return np.array(kept["theta"]), float("inf") if kept["cost"] is None else float(kept["cost"])

    first = [u for u in unknowns if u.name in _FIRST or u.name.startswith(DRIVE)]
    theta, cost = step("rod scan", lambda: _scan(search, first, ends[:2]))
    if not np.isfinite(cost):
        raise CalibrationError(
            f"none of {len(_STARTS)} starts of the bending stiffness gave a usable simulation of {search.end} frames"
        )
    theta = np.array([theta[first.index(u)] if u in first else u.start for u in unknowns])
    for number, end in enumerate([*ends, *ends[-1:] * _AGAIN]):
        before = search.sigma

        def descend(place: Array = theta, end: int = end) -> tuple[Array, float]:
            found, cost = search.descend(unknowns, place, end, _STEPS)
            residual = search.residuals([at(twin, unknowns, found)], end)[0]
            if residual is not None:
                search.sigma = max(scene.noise_sigma_m or 0.0, float(np.sqrt(np.mean(residual**2))), 1e-9)
            return found, cost

        theta, cost = step(f"rod window {number}", descend)
        if number >= len(ends) and search.sigma > _STEADY * before:
            break
    fitted = at(twin, unknowns, theta)
    found, correlated = _estimates(search, unknowns, theta)
    nodes = fitted.simulate_nodes(*scene.control_track(), scene.times)
    tracks = fitted.observe(nodes, scene.times)
    return FitResult(
        twin=fitted,
        parameters={**found, "density": _density(scene, fitted)},
        searched=tuple(unknowns),
        correlations=correlated,
        tracks=tracks,
        particles=fitted.particles_at(nodes),
        losses=training_losses(scene, tracks),
        simulations=search.simulations,
        seconds=time.perf_counter() - begun,
        loss_history=list(np.minimum.accumulate(search.history)) if search.history else [],
        cut_short=search.cut_short,
        open={name: e.note for name, e in found.items() if search.cut_short},
    )


def _scan(search: RodSearch, first: list[Parameter], ends: list[int]) -> tuple[Array, float]:
    """The best of descents from several stiffnesses over the first windows."""
    twin = search.twin
    weight = twin.density * GRAVITY * float(twin.lattice.distances.max()) ** 3  # type: ignore[attr-defined]
    found = []
    for share in _STARTS if twin.drive is None else _STIFF_STARTS:
        theta = np.array([np.log(share * weight) if u.name == _FIRST[0] else u.start for u in first])
        cost = np.inf
        for end in ends:
            theta, now = search.descend(first, theta, end, _FIRST_STEPS)
            cost = now if np.isfinite(now) else cost  # the budget may not reach a longer window
        found.append((cost, tuple(theta)))
    cost, best = min(found)
    return np.array(best), cost


def _estimates(
    search: RodSearch, unknowns: list[Parameter], theta: Array
) -> tuple[dict[str, Estimate], Correlations]:
    """Numbers with the intervals of the posterior's Gaussian about its mode."""
    names = tuple(u.name for u in unknowns)
    residual, jacobian = search.linearised(unknowns, theta, search.end)
    _, prior = _prior(unknowns, theta)
    covariance: Array = np.diag(1.0 / prior**2)
    if jacobian is not None:
        weight = 1.0 / (search.sigma**2 * search.together)
        covariance = np.linalg.inv(weight * jacobian.T @ jacobian + np.diag(prior**2))
    found = {}
    for k, unknown in enumerate(unknowns):
        half = _Z95 * float(np.sqrt(covariance[k, k]))
        known = half < 0.5 * _Z95 / prior[k]
        sure = bool(known and (unknown.transform is LINEAR or half < UNIDENTIFIED_HALF_WIDTH["log"]))
        ends = (unknown.value(theta[k] - half), unknown.value(theta[k] + half))
        note = "" if sure else "the data say little beyond its prior"
        if search.cut_short or residual is None:
            note = f"the search was cut short by its budget of {search.limit} simulations: no interval"
            found[unknown.name] = Estimate(unknown.value(float(theta[k])), unknown.unit, None, False, note)
            continue
        found[unknown.name] = Estimate(unknown.value(float(theta[k])), unknown.unit, ends, sure, note)
    return found, Correlations(names, correlations(covariance))


def _density(scene: Scene, twin: Twin) -> Estimate:
    declared = scene.body.density_kg_m3 is not None or scene.body.mass_kg is not None
    return Estimate(
        twin.density, "kg/m", None, False, f"{'as declared' if declared else 'prior'}; {RATIO_NOTE}"
    )


def _prior(unknowns: Sequence[Parameter], theta: Array) -> tuple[Array, Array]:
    """Distances from the priors in their deviations (p,), and one over the deviations."""
    known = [u.prior for u in unknowns]
    means = np.array([p[0] for p in known if p is not None])
    inverse = np.array([1.0 / p[1] for p in known if p is not None])
    return (theta - means) * inverse, inverse


def _within(unknowns: Sequence[Parameter], theta: Array) -> Array:
    low, high = (np.array(ends) for ends in zip(*(u.bounds for u in unknowns), strict=True))
    return np.clip(theta, low, high)
