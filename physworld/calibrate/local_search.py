"""The search of the local stage: fields as modes, their misfit over frames, its gradient, and what data know of them.

    log factor of a particle = sum_k phi_k z_k        prior z_k ~ N(0, 1)

One run of the twin gives the mean squared error of the seen coordinates, one reverse pass its derivative by all
coefficients of all fields; Gauss and Newton's Hessian takes one run a coefficient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from physworld.arrays import Array
from physworld.errors import CalibrationError, Cancelled, SimulationError
from physworld.estimation.journal import Journal
from physworld.estimation.simulations import Drive, Job, Runner, in_turn
from physworld.geometry.features import carry_features, part_features
from physworld.scene import Scene
from physworld.twin.gradient import TwinRun
from physworld.twin.properties import together
from physworld.twin.twin import Twin

FIELDS = ("stiffness", "density", "friction")
"""Columns of the properties of :meth:`physworld.twin.twin.Twin.simulate`."""
_INDUCING = 300  # particles that the modes are computed from
_FAILED = 1e3  # value of a run that blew up, in units of the homogeneous fit's error
_FARTHEST = (
    6.0  # log factor beyond which nothing is run: a line search may ask for any, and for any time step
)
_PROBE = 0.02  # of a coefficient, for the first Hessian
_FLAT = 1e-6  # gradient that ends a search
_LEAST_FALL, _PATIENCE = 0.01, 3  # relative fall of the objective, over so many steps, that ends a search
_LOOSE = 1e-4  # strength of the prior on the constants
_LEAST_VARIANCE_M2 = 1e-18  # of an error that is rounding
_BLOCKS = 10  # of frames, whose errors count as independent


@dataclass(frozen=True)
class LocalConfig:
    """Settings of the local stage.

    Attributes:
        fields: which logarithms vary, of "stiffness", "density" and the ground's "friction". Under gravity, ground
            and grips the motion shows the ratio of the first two: both at once is for bodies whose inertia and weight
            act apart. Friction is left out where there is no ground, and held at its prior where the data do not know
            it.
        modes: at most this many of a field.
        deviation: prior standard deviation of a log factor.
        length: correlation length, in units of the root mean squared distance of part features.
        strengths: of the prior, tried from strong to weak.
        validation: last share of the training frames that chooses among them.
        iterations: of BFGS, each time.
        least_gain: share of the validation error that a field must remove.
        memory_mb: for one gradient.
    """

    fields: tuple[str, ...] = ("stiffness", "friction")
    modes: int = 6
    deviation: float = 0.5
    length: float = 0.7
    strengths: tuple[float, ...] = (0.1, 0.01, 0.001)
    validation: float = 0.3
    iterations: int = 20
    least_gain: float = 0.05
    memory_mb: float = 100.0


def field_modes(twin: Twin, scene: Scene, config: LocalConfig) -> Array:
    """Modes (P, k) of a smooth field over the particles, scaled by the prior's standard deviation, without their mean.

    The process has a squared-exponential covariance over part features: those of the scene, or the spectral ones of
    the body's own shape. Eigenfunctions by Nyström's method.
    """
    particles = twin.particles_rest
    if scene.part_features is not None and scene.rest_volume_points is not None:
        features = carry_features(scene.rest_volume_points, scene.part_features, twin.particles_start)
    else:
        features = part_features(particles)
    count = len(particles)
    chosen = np.linspace(0, count - 1, min(_INDUCING, count)).astype(int)

    def covariance(a: Array, b: Array) -> Array:
        square = np.sum((a[:, None] - b[None]) ** 2, axis=2)
        found: Array = np.exp(-0.5 * square / config.length**2)
        return found

    values, vectors = np.linalg.eigh(covariance(features[chosen], features[chosen]))
    order = np.argsort(values)[::-1][: config.modes + 1]
    modes = covariance(features, features[chosen]) @ (vectors[:, order] / np.sqrt(values[order]))
    weight = twin.lattice.particle_measures / twin.lattice.particle_measures.sum()
    modes = modes - weight @ modes
    power = weight @ modes**2
    leading = np.sort(np.argsort(power)[::-1][: config.modes])
    scaled: Array = config.deviation * modes[:, leading]
    return scaled


class FieldSearch:
    """Errors and gradients of fields; coefficients are a constant and the modes, field after field.

    Attributes:
        fields: what is searched.
        modes: of every field, (P, k).
        size: how many coefficients.
        begin, end: training frames.
        runs: forward runs with a gradient so far.
        simulations: forward runs without one.

    What a search finished is in the journal, if there is one, and is not simulated again.

    Args:
        scene: whose training frames are fitted.
        twin: calibrated by the global stage.
        config: which fields, how smooth, how many modes.
        cancelled: polled between simulations.
        progress: called with (done, in all, message).
        journal: what was simulated before and is not again.
        runner: of simulations without a gradient.

    Raises:
        ValueError: an unknown field, or none that could be searched.
    """

    def __init__(
        self,
        scene: Scene,
        twin: Twin,
        config: LocalConfig,
        cancelled: Callable[[], bool] | None = None,
        progress: Callable[[int, int, str], None] | None = None,
        journal: Journal | None = None,
        runner: Runner = in_turn,
    ) -> None:
        unknown = sorted(set(config.fields) - set(FIELDS))
        if unknown or not config.fields:
            raise ValueError(f"no fields {unknown}; there are {FIELDS}")
        self.scene, self.twin, self._config, self._cancelled = scene, twin, config, cancelled
        self.fields = tuple(name for name in config.fields if name != "friction" or twin.contacts)
        if not self.fields:
            raise ValueError(f"fields {config.fields} need a ground; the twin has {len(twin.contacts)}")
        self.begin, self.end = max(scene.train[0], 1), scene.train[1]
        self.modes = field_modes(twin, scene, config)
        constant = np.ones((len(self.modes), 1))
        self._basis = np.concatenate([constant, self.modes], axis=1)
        self._curvatures: dict[int, Array] = {}
        self.runs = self.simulations = 0
        self._runner = runner
        self.stage, self._progress, self._journal = "local stage", progress, journal or Journal()

    @property
    def size(self) -> int:
        """Coefficients of all fields."""
        return int(self._basis.shape[1]) * len(self.fields)

    @property
    def most(self) -> int:
        """About how many runs the stage takes at most: two Hessians, and a descent for each strength and two more."""
        descents = len(self._config.strengths) + 2
        return 2 * (self.size + 2) + descents * (self._config.iterations + 2)

    def known(self, name: str, end: int, variance: float) -> float:
        """How many times as precisely as the prior the data know the best of a field's coefficients, at no field.

        The others are marginalised. Errors of frames within a tenth of the recording are not taken as independent.

        Args:
            name: of the field.
            end: data are the frames before it.
            variance: of a coordinate's error [m^2].
        """
        seen = self.scene.visible[self.begin : end]
        information = 0.5 * self._curvature(np.zeros(self.size), end) * 3 * int(seen.sum())
        information *= min(1.0, _BLOCKS / len(seen)) / max(variance, _LEAST_VARIANCE_M2)
        mine = self._slots(name)
        rest = information[np.ix_(~mine, ~mine)] + np.eye(int((~mine).sum()))
        across = information[np.ix_(mine, ~mine)]
        left = information[np.ix_(mine, mine)] - across @ np.linalg.solve(rest, across.T)
        return float(np.linalg.eigvalsh(left)[-1])

    def drop(self, name: str) -> None:
        """Hold a field at its prior from now on."""
        others = ~self._slots(name)
        self._curvatures = {end: known[np.ix_(others, others)] for end, known in self._curvatures.items()}
        self.fields = tuple(field for field in self.fields if field != name)

    def _slots(self, name: str) -> Array:
        """Which coefficients are a field's, (size,) bool."""
        return np.repeat([field == name for field in self.fields], self._basis.shape[1])

    def split(self) -> int:
        """First validation frame."""
        split = self.end - max(1, round(self._config.validation * (self.end - self.begin)))
        if split <= self.begin:
            raise CalibrationError(
                f"{self.end - self.begin} training frames leave none to validate a field on"
            )
        for first, last in ((self.begin, split), (split, self.end)):
            if not self.scene.visible[first:last].any():
                what = "search" if first == self.begin else "validate"
                raise CalibrationError(
                    f"nothing is visible in frames {first} to {last - 1}, which {what} a field"
                )
        return split

    def properties(self, z: Array) -> Array:
        """Log factors of coefficients, (P, 2), or with the friction (P, 3)."""
        found = np.zeros((len(self._basis), 3 if "friction" in self.fields else 2))
        for name, part in zip(self.fields, z.reshape(len(self.fields), -1), strict=True):
            found[:, FIELDS.index(name)] = self._basis @ part
        return found

    def _too_far(self, z: Array) -> bool:
        return not np.abs(self.properties(z)).max() <= _FARTHEST

    def errors(self, z: Array, end: int) -> Array:
        """Mean squared error [m^2] of every training frame up to ``end``; NaN where the run fails."""
        times, controls = self.scene.control_track()
        self.simulations += 1
        self._tell()
        if self._too_far(z):
            return np.full(end - self.begin, np.nan)
        try:
            nodes = self.twin.simulate_nodes(
                times, controls, self.scene.times[:end], properties=self.properties(z), progress=self._poll
            )
        except SimulationError:
            return np.full(end - self.begin, np.nan)
        error, seen = self._residual(self.twin.observe(nodes, self.scene.times[:end]), end)
        squares: Array = np.sum(error**2, axis=(1, 2)) / np.maximum(3 * seen.sum(axis=1), 1)
        return squares

    def validation_error(self, z: Array, split: int) -> float:
        """Mean squared error [m^2] on the validation frames; infinite where the run fails."""

        def measured() -> dict[str, float]:
            return {"error": float(self.errors(z, self.end)[split - self.begin :].mean())}

        found = self._step(f"field error from {split}", measured)["error"]
        return float("inf") if found is None else found

    def descend(self, z: Array, end: int, scale: float, strength: float | None) -> tuple[Array, float]:
        """Coefficients that minimise the objective over the frames up to ``end``; without a strength only constants.

        Args:
            z: coefficients of the fields, where the descent starts, (k,).
            end: of the frames that count.
            scale: of the misfit [m^2].
            strength: of the prior.
        """
        constants = np.zeros(self.size, dtype=bool)
        constants[:: self._basis.shape[1]] = True
        free = constants if strength is None else np.ones(self.size, dtype=bool)
        weight = np.where(constants, _LOOSE, strength or 0.0)

        def objective(part: Array) -> tuple[float, Array]:
            full = z.copy()
            full[free] = part
            value, slope = self._value(full, end)
            total = value / scale + float(weight @ full**2)
            return total, (slope / scale + 2 * weight * full)[free]

        values: list[float] = []

        def watch(intermediate_result: OptimizeResult) -> None:
            values.append(float(intermediate_result.fun))
            if len(values) > _PATIENCE and values[-1] > (1.0 - _LEAST_FALL) * values[-1 - _PATIENCE]:
                raise StopIteration

        curvature = self._curvature(z, end) / scale + 2 * np.diag(weight)
        inverse = np.linalg.inv(curvature[np.ix_(free, free)])
        options = {
            "maxiter": self._config.iterations,
            "gtol": _FLAT,
            "hess_inv0": 0.5 * (inverse + inverse.T),
        }

        def searched() -> dict[str, Any]:
            found = minimize(objective, z[free], jac=True, method="BFGS", callback=watch, options=options)
            return {"z": found.x.tolist(), "value": float(found.fun)}

        self.stage = "moduli of the field" if strength is None else f"field at prior strength {strength:g}"
        found = self._step(f"{self.stage} to {end}", searched)
        best = z.copy()
        best[free] = found["z"]
        return best, float("inf") if found["value"] is None else found["value"]

    def _curvature(self, z: Array, end: int) -> Array:
        """Gauss-Newton's Hessian of the mean squared error [m^2], (k, k), by one run a coefficient; kept."""
        if end not in self._curvatures:
            self.stage = "sensitivities of the field"
            found = self._step(f"{self.stage} to {end}", lambda: {"hessian": self._hessian(z, end).tolist()})
            self._curvatures[end] = np.array(found["hessian"])
        return self._curvatures[end]

    def _hessian(self, z: Array, end: int) -> Array:
        here, *there = self._seen_at([z, *(z + _PROBE * one for one in np.eye(self.size))], end)
        columns = [(tracks - here) / _PROBE for tracks in there]
        jacobian = np.nan_to_num(np.array(columns).T)
        return 2.0 * jacobian.T @ jacobian / len(here)

    def _step(self, name: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """A journalled step, which also brings the counts of runs to where they were after it."""

        def counted() -> dict[str, Any]:
            return {**compute(), "runs": self.runs, "simulations": self.simulations}

        found = self._journal.step(name, counted)
        self.runs, self.simulations = found["runs"], found["simulations"]
        return found

    def _tell(self) -> None:
        if self._progress is not None:
            done = self.runs + self.simulations
            self._progress(done, max(self.most, done), self.stage)

    def _seen_at(self, places: list[Array], end: int) -> list[Array]:
        """Predicted coordinates that were seen in the frames up to ``end``, flat, at each of several coefficients.

        NaN where a run fails. The runs do not depend on each other, so they go to the runner together.
        """
        seen = self.scene.visible[self.begin : end]
        drive = Drive(*self.scene.control_track(), self.scene.times)
        jobs = [
            Job(replace(self.twin, properties=together(self.twin.properties, self.properties(z))), end)
            for z in places
        ]
        found = []
        self._tell()
        for tracks in self._runner(jobs, drive, lambda: self._poll(0, end)):
            self.simulations += 1
            self._tell()
            found.append(
                np.full(3 * int(seen.sum()), np.nan)
                if tracks is None
                else tracks[self.begin :][seen].reshape(-1)
            )
        return found

    def _value(self, z: Array, end: int) -> tuple[float, Array]:
        """Mean squared error [m^2] up to ``end`` and its gradient by the coefficients."""
        properties = self.properties(z)
        times, controls = self.scene.control_track()
        self.runs += 1
        self._tell()
        if self._too_far(z):
            return _FAILED, np.zeros(self.size)
        try:
            run = TwinRun(
                self.twin, times, controls, self.scene.times[:end], properties=properties,
                memory_mb=self._config.memory_mb, progress=self._poll,
            )  # fmt: skip
        except SimulationError:
            return _FAILED, np.zeros(self.size)
        error, seen = self._residual(run.tracks, end)
        count = 3 * int(seen.sum())
        bar = np.zeros_like(run.tracks)
        bar[self.begin : end] = 2.0 * error / count
        gradient, _ = run.gradient(bar)
        by_field = dict(
            zip(FIELDS, (gradient.log_stiffness, gradient.log_density, gradient.log_friction), strict=True)
        )
        slope = np.concatenate([self._basis.T @ by_field[name] for name in self.fields])
        return float(np.sum(error**2)) / count, slope

    def _residual(self, tracks: Array, end: int) -> tuple[Array, Array]:
        frames = slice(self.begin, end)
        seen = self.scene.visible[frames]
        return np.where(seen[..., None], tracks[frames] - self.scene.points[frames], 0.0), seen

    def _poll(self, done: int, total: int) -> None:
        if self._cancelled is not None and self._cancelled():
            raise Cancelled(f"local stage cancelled in run {self.runs} at frame {done} of {total}")
