"""Local stage: fields of stiffness and density over the body, on top of a homogeneous fit.

    log factor of a particle = sum_k phi_k z_k        prior z_k ~ N(0, 1)

phi are the leading modes of a Gaussian process over part features (smooth along the body, blind across a gap), without
their mean, with the prior's standard deviation in them; a constant is added, so that the modulus itself may move. What
is minimised over the training frames is

    mean squared error / that of the homogeneous fit + strength * |z|^2

by BFGS with the reverse-mode gradient (:mod:`physworld.mpm.gradient_twin`). The modulus itself outweighs every mode a
hundredfold, so the first Hessian is that of Gauss and Newton, from one run a coefficient.

A few markers do not fix a field: the strength is chosen on the last part of the training frames, which that search does
not see, and a field that does not beat the homogeneous fit there is thrown away and reported so. Then it is fitted
again on all training frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from physworld.errors import CalibrationError, Cancelled, SimulationError
from physworld.geometry.features import carry_features, part_features
from physworld.mpm.gradient_twin import TwinRun
from physworld.scene import Scene
from physworld.twin import Twin

_INDUCING = 300  # particles that the modes are computed from
_FAILED = 1e3  # value of a run that blew up, in units of the homogeneous fit's error
_WORTH = 0.9  # of the validation error is what a weaker prior may leave at most
_PROBE = 0.02  # of a coefficient, for the first Hessian
_FLAT = 1e-6  # gradient that ends a search
_LEAST_FALL, _PATIENCE = 0.01, 3  # relative fall of the objective, over so many steps, that ends a search
_LOOSE = 1e-4  # strength of the prior on the constants
_FIELDS = ("stiffness", "density")


@dataclass(frozen=True)
class LocalConfig:
    """Settings of the local stage.

    Attributes:
        fields: which logarithms vary, of "stiffness" and "density". Under gravity, ground and grips the motion
            shows their ratio: both at once is for bodies whose inertia and weight act apart.
        modes: at most this many of a field.
        deviation: prior standard deviation of a log factor.
        length: correlation length, in units of the root mean squared distance of part features.
        strengths: of the prior, tried from strong to weak.
        validation: last share of the training frames that chooses among them.
        iterations: of BFGS, each time.
        least_gain: share of the validation error that a field must remove.
        memory_mb: for one gradient.
    """

    fields: tuple[str, ...] = ("stiffness",)
    modes: int = 6
    deviation: float = 0.5
    length: float = 0.7
    strengths: tuple[float, ...] = (0.1, 0.01, 0.001)
    validation: float = 0.3
    iterations: int = 20
    least_gain: float = 0.05
    memory_mb: float = 100.0


@dataclass(frozen=True)
class LocalResult:
    """What the local stage found.

    Attributes:
        properties: log factors of stiffness and density, (P, 2), for :meth:`Twin.simulate`; zero if nothing was kept.
        kept: whether the field beat the homogeneous fit on the validation frames.
        strength: chosen strength of the prior, None if nothing was kept.
        validation: mean squared error on the validation frames over the homogeneous fit's, by strength.
        tracks: tracked points over all frames, (T, N, 3) [m].
        runs: forward runs with a gradient.
        seconds: wall time.
        reason: a sentence.
    """

    properties: np.ndarray
    kept: bool
    strength: float | None
    validation: dict[float, float]
    tracks: np.ndarray
    runs: int
    seconds: float
    reason: str
    modes: np.ndarray = field(repr=False, default_factory=lambda: np.empty((0, 0)))


def fit_fields(
    scene: Scene,
    twin: Twin,
    config: LocalConfig | None = None,
    progress: Callable[[str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> LocalResult:
    """Fit fields to the training frames of a scene, on a twin that the global stage has fitted.

    Args:
        scene: the recording.
        twin: the homogeneous fit.
        config: settings; None for the defaults.
        progress: called with a sentence after every search.
        cancelled: polled every frame of every run.

    Raises:
        CalibrationError: the twin's own run fails, or no training frame is left for the validation.
        Cancelled: ``cancelled`` returned true.
        ValueError: an unknown field.
    """
    config = config or LocalConfig()
    started = time.perf_counter()
    search = _FieldSearch(scene, twin, config, cancelled)
    split = search.split()
    plain = search.errors(np.zeros(search.size), search.end)
    if not np.isfinite(plain).all():
        raise CalibrationError("the homogeneous twin's own run fails: there is nothing to build a field on")
    before = float(plain[: split - search.begin].mean())
    after = float(plain[split - search.begin :].mean())
    shift, _ = search.descend(np.zeros(search.size), split, before, strength=None)
    reference = min(after, search.validation_error(shift, split))
    validation: dict[float, float] = {}
    best, best_z, z = None, None, shift
    for strength in config.strengths:
        z, _ = search.descend(z, split, before, strength)
        ratio = search.validation_error(z, split) / reference
        validation[strength] = ratio
        if progress is not None:
            progress(f"prior strength {strength:g}: validation error {ratio:.3f} of the homogeneous fit's")
        if best is None or ratio < _WORTH * validation[best]:  # a weaker prior has to be worth it
            best, best_z = strength, z
    kept = best is not None and validation[best] < 1.0 - config.least_gain
    final = np.zeros(search.size)
    if kept and best_z is not None:
        final, _ = search.descend(best_z, search.end, float(plain.mean()), best)
    reason = (
        f"kept: {1.0 - validation[best]:.0%} less error than the homogeneous fit on frames {split} to {search.end - 1}"
        if kept and best is not None
        else f"thrown away: at best {min(validation.values()):.3f} of the homogeneous fit's error on frames {split} to "
        f"{search.end - 1}, {1.0 - config.least_gain:.2f} was asked"
    )
    properties = search.properties(final)
    times, controls = scene.control_track()
    nodes = twin.simulate_nodes(times, controls, scene.times, properties=properties)
    return LocalResult(
        properties=properties,
        kept=kept,
        strength=best if kept else None,
        validation=validation,
        tracks=twin.observe(nodes, scene.times),
        runs=search.runs,
        seconds=time.perf_counter() - started,
        reason=reason,
        modes=search.modes,
    )


def field_modes(twin: Twin, scene: Scene, config: LocalConfig) -> np.ndarray:
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

    def covariance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        square = np.sum((a[:, None] - b[None]) ** 2, axis=2)
        return np.exp(-0.5 * square / config.length**2)

    values, vectors = np.linalg.eigh(covariance(features[chosen], features[chosen]))
    order = np.argsort(values)[::-1][: config.modes + 1]
    modes = covariance(features, features[chosen]) @ (vectors[:, order] / np.sqrt(values[order]))
    weight = twin.lattice.particle_measures / twin.lattice.particle_measures.sum()
    modes = modes - weight @ modes
    power = weight @ modes**2
    leading = np.sort(np.argsort(power)[::-1][: config.modes])
    return config.deviation * modes[:, leading]


class _FieldSearch:
    """Errors and gradients of fields; coefficients are a constant and the modes, field after field."""

    def __init__(
        self, scene: Scene, twin: Twin, config: LocalConfig, cancelled: Callable[[], bool] | None
    ) -> None:
        unknown = sorted(set(config.fields) - set(_FIELDS))
        if unknown or not config.fields:
            raise ValueError(f"no fields {unknown}; there are {_FIELDS}")
        self.scene, self.twin, self._config, self._cancelled = scene, twin, config, cancelled
        self.begin, self.end = max(scene.train[0], 1), scene.train[1]
        self.modes = field_modes(twin, scene, config)
        constant = np.ones((len(self.modes), 1))
        self._basis = np.concatenate([constant, self.modes], axis=1)
        self._columns = [_FIELDS.index(name) for name in config.fields]
        self.size = self._basis.shape[1] * len(self._columns)
        self._curvatures: dict[int, np.ndarray] = {}
        self.runs = 0

    def split(self) -> int:
        """First validation frame."""
        split = self.end - max(1, round(self._config.validation * (self.end - self.begin)))
        if split <= self.begin:
            raise CalibrationError(
                f"{self.end - self.begin} training frames leave none to validate a field on"
            )
        return split

    def properties(self, z: np.ndarray) -> np.ndarray:
        """Log factors (P, 2) of coefficients."""
        found = np.zeros((len(self._basis), 2))
        for column, part in zip(self._columns, z.reshape(len(self._columns), -1), strict=True):
            found[:, column] = self._basis @ part
        return found

    def errors(self, z: np.ndarray, end: int) -> np.ndarray:
        """Mean squared error [m^2] of every training frame up to ``end``; NaN where the run fails."""
        times, controls = self.scene.control_track()
        try:
            nodes = self.twin.simulate_nodes(
                times, controls, self.scene.times[:end], properties=self.properties(z), progress=self._poll
            )
        except SimulationError:
            return np.full(end - self.begin, np.nan)
        error, seen = self._residual(self.twin.observe(nodes, self.scene.times[:end]), end)
        return np.sum(error**2, axis=(1, 2)) / np.maximum(3 * seen.sum(axis=1), 1)

    def validation_error(self, z: np.ndarray, split: int) -> float:
        """Mean squared error [m^2] on the validation frames; infinite where the run fails."""
        found = float(self.errors(z, self.end)[split - self.begin :].mean())
        return found if np.isfinite(found) else float("inf")

    def descend(
        self, z: np.ndarray, end: int, scale: float, strength: float | None
    ) -> tuple[np.ndarray, float]:
        """Coefficients that minimise the objective over the frames up to ``end``; without a strength only constants."""
        constants = np.zeros(self.size, dtype=bool)
        constants[:: self._basis.shape[1]] = True
        free = constants if strength is None else np.ones(self.size, dtype=bool)
        weight = np.where(constants, _LOOSE, strength or 0.0)

        def objective(part: np.ndarray) -> tuple[float, np.ndarray]:
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
        found = minimize(objective, z[free], jac=True, method="BFGS", callback=watch, options=options)
        best = z.copy()
        best[free] = found.x
        return best, float(found.fun)

    def _curvature(self, z: np.ndarray, end: int) -> np.ndarray:
        """Gauss-Newton's Hessian of the mean squared error [m^2], (k, k), by one run a coefficient; kept."""
        if end not in self._curvatures:
            here = self._tracks(z, end)
            columns = []
            for k in range(self.size):
                probe = z.copy()
                probe[k] += _PROBE
                columns.append((self._tracks(probe, end) - here) / _PROBE)
            jacobian = np.nan_to_num(np.array(columns).T)
            self._curvatures[end] = 2.0 * jacobian.T @ jacobian / len(here)
        return self._curvatures[end]

    def _tracks(self, z: np.ndarray, end: int) -> np.ndarray:
        """Predicted coordinates that were seen in the frames up to ``end``, flat; NaN where the run fails."""
        times, controls = self.scene.control_track()
        seen = self.scene.visible[self.begin : end]
        try:
            nodes = self.twin.simulate_nodes(
                times, controls, self.scene.times[:end], properties=self.properties(z), progress=self._poll
            )
        except SimulationError:
            return np.full(3 * int(seen.sum()), np.nan)
        return self.twin.observe(nodes, self.scene.times[:end])[self.begin :][seen].reshape(-1)

    def _value(self, z: np.ndarray, end: int) -> tuple[float, np.ndarray]:
        """Mean squared error [m^2] up to ``end`` and its gradient by the coefficients."""
        properties = self.properties(z)
        times, controls = self.scene.control_track()
        self.runs += 1
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
        by_field = (gradient.log_stiffness, gradient.log_density)
        slope = np.concatenate([self._basis.T @ by_field[column] for column in self._columns])
        return float(np.sum(error**2)) / count, slope

    def _residual(self, tracks: np.ndarray, end: int) -> tuple[np.ndarray, np.ndarray]:
        frames = slice(self.begin, end)
        seen = self.scene.visible[frames]
        return np.where(seen[..., None], tracks[frames] - self.scene.points[frames], 0.0), seen

    def _poll(self, done: int, total: int) -> None:
        if self._cancelled is not None and self._cancelled():
            raise Cancelled(f"local stage cancelled in run {self.runs} at frame {done} of {total}")
