"""Calibration of measured cloths that hang from a bar: sheet, air and camera at once, each number with a prior.

    minimise  sum_t rho(q_t) / n_t  +  sum ((theta - mean) / deviation)^2
    q_t = min over d of  n_p sum_p |r_p(t) + d v_p(t)|^2 / sigma^2 + d^2 / sigma_d^2

r are the residuals of the tracked points of a frame, v their velocities, d the error of the frame's stamp: depth
cameras deliver late by some hundredths of a second, each frame by another time. Of a frame's points n_p in all count as
independent, since a tracker errs with the whole grid; neighbouring frames err alike, n_t of them count as one; rho is
the pseudo-Huber function, for a tracker loses the cloth now and then.

Unknown are the sheet (bending stiffness, mass per area, internal friction), the air around it (``air_on_sheet``), and
the camera: its delay (``actuation_lag``), its turn against the grips' frame (``measurement_turn``) and its scale. The
camera's numbers cost no run: a run is followed at the controllers' own rate and read at other times.

Priors: woven cotton bends with 1e-5 to 1e-4 N m (Wang, O'Brien and Ramamoorthi 2011; Clyde 2017) and weighs 0.15 to
0.4 kg/m^2; drag and added mass of plates in air as in :mod:`physworld.effects.air_on_sheet`; cameras are calibrated to
2 degrees, 3 % and 0.04 s. The membrane is as stiff as leaves a sag of a percent or so, which limits the time step.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from physworld.arrays import Array
from physworld.calibrate.estimates import Correlations, Estimate
from physworld.calibrate.parameters import Parameter
from physworld.calibrate.recordings import (
    SAYS_NOTHING,
    Agreement,
    agreement_of,
    of_one_object,
    of_recording,
    recorded,
    together,
)
from physworld.effects.actuation_lag import ActuationLag
from physworld.effects.air_on_sheet import AirOnSheet
from physworld.effects.base import Effect
from physworld.effects.measurement_scale import MeasurementScale
from physworld.effects.measurement_turn import MeasurementTurn
from physworld.errors import CalibrationError, Cancelled, SimulationError
from physworld.estimation.journal import Journal
from physworld.estimation.least_squares import correlations, damped_step
from physworld.estimation.unknowns import LINEAR, LOG, at, bounds_of
from physworld.scene import Scene
from physworld.twin.twin import Twin

if TYPE_CHECKING:
    from physworld.calibrate.global_stage import CalibrationConfig, FitResult

Progress = Callable[[int, int, str], None]

_AREA_DENSITY = 0.25  # kg/m^2, where none is declared
_AIR_KG_M3 = 1.2
_MEMBRANE = 60.0  # times the weight of a strip of unit width
_STRIDE = 0.1  # of a prior's deviation: the step of finite differences
_STEPS, _TRIALS, _SETTLED = 8, 4, 2e-3
_LONGEST = 2.0  # deviations of the prior in a step
_SIGMA_SHARE = 0.04  # of the side: what a sheet leaves of tracked points
_POINTS, _FRAMES = 8.0, 3.0  # points of a frame that err apart; frames that err alike
_STAMP_S = 0.04  # deviation of a frame's stamp
_HUBER = 1.5  # deviations of a whole frame
_AHEAD_S = 0.15  # beyond the last frame, for cameras that run ahead
_Z95 = 1.96


def cloth_parameters(scene: Scene, twin: Twin, damping: bool = True) -> list[Parameter]:
    """What is searched: first what a run depends on, then the camera's.

    Args:
        scene: whose declared mass is kept.
        twin: of a hung sheet.
        damping: drag and internal friction are searched.
    """
    side = float(np.ptp(twin.lattice.particle_coordinates, axis=0).max())
    carried = np.pi / 8.0 * _AIR_KG_M3 * side
    found = [_number("bending_n_m", "N m", 3e-5, 1.5)]
    if scene.body.mass_kg is None and scene.body.density_kg_m3 is None:
        found.append(_number("density_kg_m2", "kg/m^2", _AREA_DENSITY, 0.6))
    found.append(_strength(AirOnSheet(), "added_kg_m2", "kg/m^2", carried, 0.5))
    if damping:
        found += [
            _number("relaxation_s", "s", 2e-3, 1.0),
            _strength(AirOnSheet(), "quadratic_kg_m3", "kg/m^3", 3.0, 0.7),
            _strength(AirOnSheet(), "linear_pa_s_m", "Pa s/m", 0.05, 1.5),
        ]
    found += [_strength(MeasurementTurn(), f"{axis}_rad", "rad", 0.0, 0.03) for axis in "xyz"]
    return [
        *found,
        _strength(MeasurementScale(), "scale", "1", 0.0, 0.03),
        _strength(ActuationLag(), "lag_s", "s", 0.0, 0.04),
    ]


@dataclass
class _Search:
    """Runs of one calibration."""

    scene: Scene
    twin: Twin
    unknowns: list[Parameter]
    limit: int
    progress: Progress | None
    cancelled: Callable[[], bool] | None

    def __post_init__(self) -> None:
        self.mean = np.array([u.start for u in self.unknowns])
        self.spread = np.array([1.0 if u.prior is None else u.prior[1] for u in self.unknowns])
        self.runs = sum(u.name.split(".")[0] not in _CAMERA for u in self.unknowns)
        end = self.scene.train[1]
        self.seen, self.target = self.scene.visible[1:end], self.scene.points[1:end]
        self.times = self.scene.times[1:end]
        side = float(np.ptp(self.twin.lattice.particle_coordinates, axis=0).max())
        self.sigma = max(self.scene.noise_sigma_m or 0.0, _SIGMA_SHARE * side)
        self.simulations, self.cut_short = 0, False
        self.history: list[float] = []
        self._runs: dict[tuple[float, ...], PchipInterpolator | None] = {}

    def paths(self, theta: Array) -> PchipInterpolator | None:
        """Tracked points against time in the grips' frame and clock; None where the run cannot be trusted."""
        key = tuple(theta[: self.runs])
        if key not in self._runs:
            if self.cancelled is not None and self.cancelled():
                raise Cancelled(f"calibration cancelled after {self.simulations} runs")
            self.simulations += 1
            clock, controls = self.scene.control_track()
            frames = np.union1d(
                clock[(clock >= 0.0) & (clock <= self.times[-1])], self.scene.times[: len(self.times) + 1]
            )
            frames = np.append(frames, frames[-1] + _AHEAD_S)
            twin = at(self.twin, self.unknowns[: self.runs], theta[: self.runs])
            if len(self._runs) > len(self.unknowns):
                self._runs.clear()
            try:
                nodes = twin.simulate_nodes(clock, controls, frames)
                self._runs[key] = PchipInterpolator(frames, twin.track_nodes(nodes), axis=0)
            except SimulationError:
                self._runs[key] = None
        return self._runs[key]

    def residuals(self, theta: Array) -> Any:
        """Rows of a frame, (T, 3 N + 1): points' and the stamp's residuals in their deviations; None for no run."""
        paths = self.paths(theta)
        if paths is None:
            return None
        turn, scale, lag = theta[-5:-2], float(theta[-2]), float(theta[-1])
        wanted = np.clip(self.times - lag, paths.x[0], paths.x[-1])
        begin, moved = paths(paths.x[0]), paths(wanted) - paths(paths.x[0])
        predicted = begin + (1.0 + scale) * (moved + np.cross(turn, moved))
        off = np.where(self.seen[..., None], self.scene.weighed(predicted - self.target), 0.0)
        speed = np.where(self.seen[..., None], self.scene.weighed(paths(wanted, 1)), 0.0)
        share = np.minimum(_POINTS / np.maximum(self.seen.sum(axis=1), 1), 1.0) / self.sigma**2
        pull = share * np.einsum("tni,tni->t", speed, off)
        stamp = -pull / (share * np.einsum("tni,tni->t", speed, speed) + _STAMP_S**-2)
        off = np.sqrt(share)[:, None, None] * (off + stamp[:, None, None] * speed)
        return np.concatenate([off.reshape(len(off), -1), stamp[:, None] / _STAMP_S], axis=1)

    def misfit(self, rows: Any) -> float:
        """The robust cost of rows of residuals."""
        return self.weights(rows)[0]

    def weights(self, rows: Array) -> tuple[float, Array]:
        """The robust cost of rows of residuals and the weights of their frames."""
        limit = _HUBER**2 * 3.0 * _POINTS
        root = np.sqrt(1.0 + (rows**2).sum(axis=1) / limit)
        return float(2.0 * limit * (root - 1.0).sum()) / _FRAMES, 1.0 / (root * _FRAMES)

    def cost(self, rows: Any, theta: Array) -> float:
        """Of residuals and of what the unknowns are off their priors."""
        if rows is None:
            return float("inf")
        return self.misfit(rows) + float(np.sum(((theta - self.mean) / self.spread) ** 2))

    def normal(self, theta: Array, rows: Any) -> tuple[Array, Array]:
        """Normal matrix (p, p) and gradient (p,) at theta, half the second and first derivatives of the cost."""
        matrix, gradient = self.information(theta, rows)
        return matrix + np.diag(self.spread**-2.0), gradient + (theta - self.mean) / self.spread**2

    def information(self, theta: Array, rows: Any) -> tuple[Array, Array]:
        """The same without the priors."""
        columns = []
        for k, step in enumerate(_STRIDE * self.spread):
            there = self.residuals(theta + step * np.eye(len(theta))[k])
            columns.append(np.zeros_like(rows) if there is None else (there - rows) / step)
        jacobian = np.stack(columns, axis=-1)
        weight = self.weights(rows)[1]
        matrix: Array = np.einsum("t,tmi,tmj->ij", weight, jacobian, jacobian)
        gradient: Array = np.einsum("t,tmi,tm->i", weight, jacobian, rows)
        return matrix, gradient

    def descend(self) -> tuple[Array, Array]:
        """Gauss-Newton from the priors' means: where it ends, and the normal matrix there."""
        theta = self.mean.copy()
        rows = self.residuals(theta)
        if rows is None:
            raise CalibrationError(f"the prior of {self.scene.name} gave no usable simulation")
        cost, damping, matrix = self.cost(rows, theta), 1e-2, np.diag(self.spread**-2.0)
        for _ in range(_STEPS):
            if self.simulations + self.runs + _TRIALS > self.limit:
                self.cut_short = True
                break
            matrix, gradient = self.normal(theta, rows)
            before = cost
            for _ in range(_TRIALS):
                trial = theta + damped_step(matrix, gradient, damping, _LONGEST * self.spread)
                trial = np.clip(trial, *bounds_of(self.unknowns))
                found = self.residuals(trial)
                if found is not None and self.cost(found, trial) < cost:
                    theta, rows, cost = trial, found, self.cost(found, trial)
                    damping /= 5.0
                    break
                damping = max(8.0 * damping, 0.05)
            self.history.append(cost)
            if self.progress is not None:
                self.progress(self.simulations, self.limit, f"cost {cost:.1f}")
            if before - cost < _SETTLED * before:
                break
        return theta, matrix

    def agreement(self, theta: Array) -> tuple[Agreement, ...]:
        """Whether several recordings agree on the object's numbers: of one there is nothing to be said."""
        return ()


class _Shared(_Search):
    """Runs of a calibration over several recordings, each of which has a camera of its own; see :class:`_Search`."""

    def __init__(self, parts: list[_Search], unknowns: list[Parameter]) -> None:
        lead = parts[0]
        super().__init__(lead.scene, lead.twin, unknowns, lead.limit, lead.progress, lead.cancelled)
        self.parts, self.runs = parts, max(part.runs for part in parts)
        self.places = [of_recording(unknowns, k) for k in range(len(parts))]

    def residuals(self, theta: Array) -> Any:
        """Rows of every recording; None where one of them has no run."""
        found = [part.residuals(theta[own]) for part, own in zip(self.parts, self.places, strict=True)]
        self.simulations = max(part.simulations for part in self.parts)
        return None if any(rows is None for rows in found) else found

    def misfit(self, rows: Any) -> float:
        """The robust cost of all of them."""
        return sum(part.misfit(own) for part, own in zip(self.parts, rows, strict=True))

    def information(self, theta: Array, rows: Any) -> tuple[Array, Array]:
        """What all of them say together, without the priors."""
        matrix, gradient = np.zeros((len(theta), len(theta))), np.zeros(len(theta))
        for part, own, there in zip(self.parts, self.places, rows, strict=True):
            known, pull = part.information(theta[own], there)
            matrix[np.ix_(own, own)] += known
            gradient[own] += pull
        self.simulations = max(part.simulations for part in self.parts)
        return matrix, gradient

    def agreement(self, theta: Array) -> tuple[Agreement, ...]:
        """Whether the recordings agree on the sheet and the air around it."""
        rows, shifted = self.residuals(theta), []
        for part, own, there in zip(self.parts, self.places, rows or (), strict=bool(rows)):
            known, pull = part.information(theta[own], there)
            covariance = np.linalg.inv(known + np.diag(self.spread[own] ** -2.0))
            deviation = np.sqrt(np.diag(covariance))
            deviation[deviation > SAYS_NOTHING * self.spread[own]] = np.inf
            shifted.append((own, -covariance @ pull, deviation))
        return agreement_of(self.unknowns, theta, shifted)


def calibrate_cloth(
    scenes: Sequence[Scene],
    twins: Sequence[Twin],
    config: CalibrationConfig,
    progress: Progress | None,
    cancelled: Callable[[], bool] | None,
    journal: Journal | None,
) -> FitResult:
    """Fit a hung sheet to the training frames of recordings; see the module's text.

    Args:
        scenes: the recordings.
        twins: of each, with prior numbers.
        config: settings; ``damping`` "none" searches neither drag nor internal friction.
        progress: called with (runs done, runs at most, message).
        cancelled: polled before every run.
        journal: finished steps of an earlier attempt.

    Raises:
        CalibrationError: the priors gave no usable simulation.
        Cancelled: ``cancelled`` returned true.
    """
    from physworld.calibrate.global_stage import FitResult

    begun = time.perf_counter()
    twins = of_one_object([with_priors(*pair) for pair in zip(scenes, twins, strict=True)])
    each = [cloth_parameters(*pair, config.damping == "auto") for pair in zip(scenes, twins, strict=True)]
    unknowns = together(each, lambda name: name.split(".")[0] in _CAMERA)
    parts = [
        _Search(
            *pair,
            [unknowns[p] for p in of_recording(unknowns, k)],
            config.max_simulations,
            progress,
            cancelled,
        )
        for k, pair in enumerate(zip(scenes, twins, strict=True))
    ]
    search = parts[0] if len(parts) == 1 else _Shared(parts, unknowns)

    def descend() -> dict[str, Any]:
        theta, matrix = search.descend()
        return {"theta": theta.tolist(), "matrix": matrix.tolist(), "simulations": search.simulations,
                "history": search.history, "cut_short": search.cut_short}  # fmt: skip

    kept = (journal or Journal()).step("cloth", descend)
    theta, covariance = np.array(kept["theta"]), np.linalg.inv(np.array(kept["matrix"]))
    predicted = [
        recorded(part.scene, at(part.twin, part.unknowns, theta[of_recording(unknowns, k)]), config.placed)
        for k, part in enumerate(parts)
    ]
    lead = predicted[0]
    found = _estimates(unknowns, theta, covariance, kept["cut_short"])
    return FitResult(
        twin=lead.twin,
        parameters=found,
        searched=tuple(unknowns),
        correlations=Correlations(tuple(u.name for u in unknowns), correlations(covariance)),
        tracks=lead.tracks,
        particles=lead.particles,
        losses=lead.losses,
        simulations=kept["simulations"],
        seconds=time.perf_counter() - begun,
        loss_history=list(kept["history"]),
        cut_short=kept["cut_short"],
        open={name: known.note for name, known in found.items() if kept["cut_short"]},
        recordings=tuple(predicted) if len(predicted) > 1 else (),
        agreement=() if kept["cut_short"] else search.agreement(theta),
    )


_CAMERA = (MeasurementTurn.name, MeasurementScale.name, ActuationLag.name)


def with_priors(scene: Scene, twin: Twin) -> Twin:
    """The twin with the mass of a woven cloth where none is declared, and a membrane that hardly sags."""
    if scene.body.mass_kg is None and scene.body.density_kg_m3 is None:
        twin = twin.with_parameters(density_kg_m2=_AREA_DENSITY)
    length = float(np.ptp(twin.body.start[:, 2]))
    weight = twin.density * float(np.linalg.norm(scene.gravity_m_s2)) * length
    return twin.with_parameters(membrane_n_m=_MEMBRANE * weight)


def _estimates(unknowns: list[Parameter], theta: Array, covariance: Array, cut: bool) -> dict[str, Estimate]:
    """Numbers with the intervals of the posterior's Gaussian about its mode."""
    found = {}
    for k, unknown in enumerate(unknowns):
        half = _Z95 * float(np.sqrt(covariance[k, k]))
        known = unknown.prior is not None and half < 0.5 * _Z95 * unknown.prior[1]
        note = "" if known else "the data say little beyond its prior"
        ends = (unknown.value(theta[k] - half), unknown.value(theta[k] + half))
        if cut:
            note, known = "the search was cut short by its budget of simulations: no interval", False
        found[unknown.name] = Estimate(
            unknown.value(float(theta[k])), unknown.unit, None if cut else ends, known, note
        )
    return found


def _number(name: str, unit: str, mean: float, spread: float) -> Parameter:
    """A positive number of the twin with a log-normal prior."""
    return _positive(name, unit, mean, spread, lambda twin, value: twin.with_parameters(**{name: value}))


def _strength(known: Effect, gate: str, unit: str, mean: float, spread: float) -> Parameter:
    """A strength of an effect: log-normal about a mean, or Gaussian about 0."""

    def apply(twin: Twin, value: float) -> Twin:
        present = next((e for e in twin.effects if e.name == known.name), known)
        return twin.with_effect(replace(present, **{gate: value}))

    name = f"{known.name}.{gate}"
    if mean > 0.0:
        return _positive(name, unit, mean, spread, apply)
    return Parameter(
        name, unit, -4.0 * spread, 4.0 * spread, apply, transform=LINEAR, step=_STRIDE * spread,
        prior=(0.0, spread), starts=(0.0,), stage="optional",
    )  # fmt: skip


def _positive(
    name: str, unit: str, mean: float, spread: float, apply: Callable[[Twin, float], Twin]
) -> Parameter:
    middle = float(np.log(mean))
    return Parameter(
        name, unit, float(np.exp(middle - 4.0 * spread)), float(np.exp(middle + 4.0 * spread)), apply, transform=LOG,
        step=_STRIDE * spread, start=middle, prior=(middle, spread), starts=(mean,), stage="optional",
    )  # fmt: skip
