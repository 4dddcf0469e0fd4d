"""Calibration of discrete rods: all of a rod's numbers at once, each with a prior, over windows of frames that grow.

    minimise  sum r^2 / (n_c sigma^2)  +  sum ((theta - mean) / deviation)^2

r are the residuals of the tracked points on the training frames. sigma is what the model leaves of them, found as it
goes on (the tracking noise at least); neighbouring frames err alike, so that n_c of them, those within 2 sqrt(L / g),
count as one. Nothing is selected: a number that the data do not ask for stays near its prior, and the report says so.

1. Stiffness, internal friction and drag from several starts, over the first frames.
2. All unknowns, Gauss-Newton, over 17, 43, 71 and 100 % of the training frames (of a body that is driven from inside,
   since the first step): a window that grows finds the basin that all frames at once miss.

A launch integrates a twin and what differs from it by one step in each number, side by side; it is counted as one
simulation. Priors: curvature of its own as of a coil of some windings, torsion of a round section, air drag of ropes
and foam rods in air, friction and creep small.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
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
from physworld.engine.rods.chain import Chain
from physworld.engine.rods.discrete_rods import DiscreteRods
from physworld.errors import CalibrationError, Cancelled, SimulationError
from physworld.estimation.journal import Journal
from physworld.estimation.least_squares import correlations
from physworld.estimation.unknowns import LINEAR, LOG, at
from physworld.materials.cable import CableLaw
from physworld.scene import Scene
from physworld.twin.rods import driven_at, first_mode, is_pose, shapes
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
_ENOUGH, _SETTLED = 1e-4, 3e-3  # relative falls of the cost: what counts, and what is worth another Jacobian
_CORRELATED = 2.0  # times sqrt(L / g)
_SIGMA_SHARE = 0.005  # of the length: what a rod leaves before anything is known
_GRIP_RAD, _BRANCH_RAD = 0.5, 0.3
_STEP_S, _QUIET, _GOES = (
    0.1,
    0.05,
    0.2,
)  # of a step that is driven from inside: shares of how far the points go in all
_ONSET_S, _RISE_S = 0.05, 0.06
_COIL = 4.0  # curvature of its own times the length, of the smoothest shape: a cable that was coiled
_GRAVITY = 9.81
_Z95 = 1.96


def rod_parameters(scene: Scene, twin: Twin) -> list[Parameter]:
    """Everything of a discrete rod that is searched, with its prior."""
    lattice, law = twin.lattice, twin.law
    assert isinstance(lattice, Chain) and isinstance(law, CableLaw) and twin.natural is not None
    length = float(lattice.distances.max())
    weight = law.density * _GRAVITY * length**3
    slow = float(np.sqrt(length))
    found = [
        _number("bending_n_m2", "N m^2", 1e-2 * weight, 2.5, 0.05),
        _number("relaxation_s", "s", 0.02 * slow, 1.5),
        _number("air_drag_per_s", "1/s", 0.1, 1.5),
        _number("drag_normal_per_m", "1/m", 0.1, 1.5),
        _number("stretching_n", "N", law.stretching_n, 1.0),
        _number("torsion_ratio", "1", law.torsion_ratio, 0.5),
        _number("friction_per_m", "1/m", 0.3 / length, 1.5),
        _number("friction_onset_per_m", "1/m", 1.0 / length, 1.0),
        _number("creep_ratio", "1", 0.1, 1.5),
        _number("creep_s", "s", 1.5, 1.0),
    ]
    for row in range(len(twin.held_nodes)):
        if is_pose(twin.controllers_start[twin.controller_groups[row]]):
            found += [
                _natural(twin, row, axis, f"grip_angle_{row}_{axis}", "rad", _GRIP_RAD) for axis in range(2)
            ]
    for number in range(len(lattice.branches)):
        row = len(twin.held_nodes) + number
        found += [
            _natural(twin, row, axis, f"branch_{number}_angle_{axis}", "rad", _BRANCH_RAD)
            for axis in range(2)
        ]
    for mode, row in enumerate(range(first_mode(twin), len(twin.natural))):
        spread = _COIL / (length * (1 + mode))
        found += [_natural(twin, row, axis, f"curvature_{mode}_{axis}", "1/m", spread) for axis in range(2)]
    found.append(_natural(twin, first_mode(twin), 2, "natural_twist", "1/m", 1.0 / length))
    found += [u for step in range(len(_steps(twin))) for u in _driven(twin, step, length)]
    for number, particles in enumerate(_branches(lattice)):
        found += [
            _branch(number, particles, 0, "stiffness", 2.0, len(twin.particles_rest)),
            _branch(number, particles, 1, "density", 0.5, len(twin.particles_rest)),
        ]
    return found


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
        self.together = max(1.0, _CORRELATED * float(np.sqrt(length / _GRAVITY)) / step)

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
        target = self.scene.points[1:end][mask]
        return [
            None if tracks is None else (tracks[1:][mask] - target).ravel()
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
        """Gauss-Newton with priors over the frames up to ``end``: where it ends, and the cost there."""
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
    held = (*config.held, *(_LOSSES if config.damping == "none" else ()))
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

    first = [u for u in unknowns if u.name in _FIRST or u.name.startswith("drive_")]
    theta, cost = step("rod scan", lambda: _scan(search, first, ends[:2]))
    if not np.isfinite(cost):
        raise CalibrationError(
            f"none of {len(_STARTS)} starts of the bending stiffness gave a usable simulation of {search.end} frames"
        )
    theta = np.array([theta[first.index(u)] if u in first else u.start for u in unknowns])
    for number, end in enumerate(ends):

        def descend(place: Array = theta, end: int = end) -> tuple[Array, float]:
            found, cost = search.descend(unknowns, place, end, _STEPS)
            residual = search.residuals([at(twin, unknowns, found)], end)[0]
            if residual is not None:
                search.sigma = max(scene.noise_sigma_m or 0.0, float(np.sqrt(np.mean(residual**2))), 1e-9)
            return found, cost

        theta, cost = step(f"rod window {number}", descend)
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


_LOSSES = ("relaxation_s", "air_drag_per_s", "drag_normal_per_m", "friction_per_m", "friction_onset_per_m",
           "creep_ratio", "creep_s")  # fmt: skip


def _scan(search: RodSearch, first: list[Parameter], ends: list[int]) -> tuple[Array, float]:
    """The best of descents from several stiffnesses over the first windows."""
    twin = search.twin
    weight = twin.density * _GRAVITY * float(twin.lattice.distances.max()) ** 3  # type: ignore[attr-defined]
    found = []
    for share in _STARTS if twin.drive is None else _STIFF_STARTS:
        theta = np.array([np.log(share * weight) if u.name == _FIRST[0] else u.start for u in first])
        cost = np.inf
        for end in ends:
            theta, cost = search.descend(first, theta, end, _FIRST_STEPS)
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
        sure = known and (unknown.transform is LINEAR or half < UNIDENTIFIED_HALF_WIDTH["log"])
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


def _number(name: str, unit: str, mean: float, spread: float, step: float = 0.02) -> Parameter:
    """A positive number with a log-normal prior."""
    low, high = mean * np.exp(-4.0 * spread), mean * np.exp(4.0 * spread)
    return Parameter(
        name, unit, low, high, lambda twin, value: twin.with_parameters(**{name: value}),
        transform=LOG, step=step, start=float(np.log(mean)), prior=(float(np.log(mean)), spread), starts=(mean,),
        stage="optional",
    )  # fmt: skip


def _driven(twin: Twin, step: int, length: float) -> list[Parameter]:
    """A step of what drives a rod from inside: when, how fast, and how far; one that vents goes back to nothing."""
    begin, vents = float(_steps(twin)[step, 0]), bool(_vents(_steps(twin))[step])
    numbers = [
        (0, f"drive_{step}_s", "s", begin, _ONSET_S, LINEAR, 0.002),
        (1, f"drive_{step}_rise_s", "s", _RISE_S, 1.0, LOG, 0.05),
        (2, f"drive_{step}_curvature_0", "1/m", 0.0, _COIL / length, LINEAR, 0.01 / length),
        (3, f"drive_{step}_curvature_1", "1/m", 0.0, _COIL / length, LINEAR, 0.01 / length),
        (4, f"drive_{step}_stretch", "1", 0.0, 0.05, LINEAR, 1e-3),
    ]  # fmt: skip
    found = []
    for column, name, unit, mean, spread, transform, difference in numbers[: 2 if vents else None]:

        def apply(changed: Twin, value: float, column: int = column) -> Twin:
            drive = _steps(changed).copy()
            drive[step, column] = value
            for row in np.flatnonzero(_vents(drive)):
                drive[row, 2:5] = -drive[:row, 2:5].sum(axis=0)
            return replace(changed, drive=drive)

        start = transform.searched(mean)
        ends = start - 5.0 * spread, start + 5.0 * spread
        found.append(
            Parameter(
                name, unit, transform.value(ends[0]), transform.value(ends[1]), apply, transform=transform,
                step=difference, start=start, prior=(start, spread), starts=(mean,), stage="optional",
            )
        )  # fmt: skip
    return found


def _steps(twin: Twin) -> Array:
    return np.zeros((0, 6)) if twin.drive is None else twin.drive


def _vents(drive: Array) -> Array:
    """Which steps (J, 6) go back to nothing."""
    vents: Array = drive[:, 5] > 0.0
    return vents


def steps_seen(scene: Scene) -> Array | None:
    """Steps of a body that moves by itself, (J, 6), when they begin and which of them vent; None where there are none.

    """Steps of a body that moves by itself, (J, 6), when they begin and which vent; None where there are none.
    after which they are about where they began vents: what drove them is gone.
    """
    end = scene.train[1]
    times, moved = scene.times[:end], scene.controllers[:end] - scene.controllers[0]
    seen = scene.visible[:end].all(axis=1)
    if np.abs(moved).max(initial=0.0) > 0.0 or seen.sum() < 4:
        return None
    path = scene.points[:end][seen].mean(axis=1)
    times = times[seen]
    spread = float(np.linalg.norm(path - path[0], axis=1).max())
    found: list[float] = []
    for k in range(len(times)):
        before, after = np.searchsorted(times, [times[k] - _STEP_S, times[k] + _STEP_S])
        after = min(after, len(times) - 1)
        quiet = np.linalg.norm(path[before : k + 1] - path[k], axis=1).max() < _QUIET * spread
        goes = np.linalg.norm(path[after] - path[k]) > _GOES * spread
        if quiet and goes:
            if found and times[k] - found[-1] <= 2.0 * _STEP_S:
                found.pop()  # the last quiet moment is the one
            found.append(float(times[k]))
    if not found:
        return None
    drive = np.zeros((len(found), 6))
    drive[:, 0], drive[:, 1] = found, _RISE_S
    for row, (begin, until) in enumerate(pairwise([*found, float(times[-1]) + 2.0 * _STEP_S])):
        after = path[(times > begin + _STEP_S) & (times < until - _STEP_S)]
        drive[row, 5] = len(after) > 0 and np.linalg.norm(after.mean(axis=0) - path[0]) < _GOES * spread
    return drive


def _natural(twin: Twin, row: int, column: int, name: str, unit: str, spread: float) -> Parameter:
    """An amplitude of the natural curvature or twist with a Gaussian prior about what the twin has of it."""
    assert twin.natural is not None
    mean = float(twin.natural[row, column])

    def apply(twin: Twin, value: float) -> Twin:
        assert twin.natural is not None
        natural = twin.natural.copy()
        natural[row, column] = value
        return replace(twin, natural=natural)

    return Parameter(
        name, unit, mean - 5.0 * spread, mean + 5.0 * spread, apply, transform=LINEAR, step=0.05 * spread,
        start=mean, prior=(mean, spread), starts=(mean,), stage="optional",
    )  # fmt: skip


def _branches(lattice: Chain) -> list[Array]:
    """Particles of every branch of a cable: what does not lie on its way from the first node to the longest end."""
    edges = np.arange(1, len(lattice.parent))
    new = [int(e) for e in edges if lattice.parent[e] != e - 1]
    ends = [*new[1:], len(lattice.parent)] if new else []
    return [
        np.concatenate([[2 * (e - 1), 2 * (e - 1) + 1] for e in range(begin, end)])
        for begin, end in zip(new, ends, strict=True)
    ]


def _branch(number: int, particles: Array, column: int, what: str, spread: float, count: int) -> Parameter:
    """The stiffness or density of a branch over the cable's, with a log-normal prior."""

    def apply(twin: Twin, value: float) -> Twin:
        properties = np.zeros((count, 2)) if twin.properties is None else twin.properties.copy()
        properties[particles, column] = np.log(value)
        return replace(twin, properties=properties)

    return Parameter(
        f"branch_{number}_{what}", "1", np.exp(-4 * spread), np.exp(4 * spread), apply, transform=LOG, step=0.05,
        prior=(0.0, spread), starts=(1.0,), stage="optional",
    )  # fmt: skip


def _prior(unknowns: Sequence[Parameter], theta: Array) -> tuple[Array, Array]:
    """Distances from the priors in their deviations (p,), and one over the deviations."""
    known = [u.prior for u in unknowns]
    means = np.array([p[0] for p in known if p is not None])
    inverse = np.array([1.0 / p[1] for p in known if p is not None])
    return (theta - means) * inverse, inverse


def _within(unknowns: Sequence[Parameter], theta: Array) -> Array:
    low, high = (np.array(ends) for ends in zip(*(u.bounds for u in unknowns), strict=True))
    return np.clip(theta, low, high)
