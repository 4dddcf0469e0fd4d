"""Model predictive path integral control over a world model (Williams et al. 2017, "Information theoretic MPC for
model-based reinforcement learning", algorithm 2), here as an optimiser of one open-loop motion.

Every iteration draws K noisy versions u + ε_k of the velocities u (T, G, 3), cuts them to the limits, rolls all of them
out in one batch, and moves u to their average under

    w_k ∝ exp(-(S_k - min S) / λ),      u ← Σ_k w_k (u + ε_k)

(the paper's update without its control cost γ; effort is part of S_k). ε is coloured noise, power 1/f^β over the ticks
(Pinneri et al. 2020, "Sample-efficient cross-entropy method for real-time planning", section 3.1): white noise on
velocities hardly moves a grip. λ is a share of the spread of the better half of the costs, so that it needs no scale.
The noise's size follows the weighted spread of the samples, for each grip and axis (as in Bhardwaj et al. 2021,
"STORM", section 3.2). The best motion seen is kept among the samples, and is the answer.

    S = mean over the settling ticks of distance(goal) + a share of its mean over all ticks + effort
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.errors import Cancelled, UnstableSimulation
from physworld.planning.goals import Goal, GripLimits

Predict = Callable[[Array], Array]
"""Predicted points (B, T, N, 3) [m] for displacements (B, T, G, 3) [m] of the grips at ticks 1 … T."""


@dataclass(frozen=True)
class MppiConfig:
    """Settings of the search.

    Attributes:
        horizon: T, ticks.
        samples: K, motions in an iteration.
        iterations: of them.
        noise_share: standard deviation of ε at the start, in units of the speed limit.
        noise_memory: share of its old variance that each iteration keeps.
        noise_floor: least of it, in units of its start.
        colour: β of its spectrum.
        temperature: λ in units of the spread of the better half of the costs.
        settle: share of the horizon, its last ticks, over which the goal counts.
        path_share: weight of the mean distance over all ticks.
        effort_share: weight of the root mean square acceleration, in units of what a full stop within one tick takes,
            times the distance at the start.
        chunk: motions rolled out at a time.
    """

    horizon: int = 60
    samples: int = 512
    iterations: int = 10
    noise_share: float = 0.4
    noise_memory: float = 0.3
    noise_floor: float = 0.02
    colour: float = 2.5
    temperature: float = 0.3
    settle: float = 0.2
    path_share: float = 0.05
    effort_share: float = 0.02
    chunk: int = 128

    def __post_init__(self) -> None:
        if self.horizon < 2 or self.samples < 2 or self.iterations < 1 or self.chunk < 1:
            raise ValueError(
                f"horizon {self.horizon}, samples {self.samples}, iterations {self.iterations}, chunk {self.chunk}"
            )

    @property
    def settling(self) -> int:
        """Ticks at the end over which the goal counts."""
        return max(1, round(self.settle * self.horizon))


@dataclass(frozen=True)
class Found:
    """The answer.

    Attributes:
        displacements: of the grips at ticks 1 … T [m], (T, G, 3).
        points: predicted, (T, N, 3) [m].
        distance_m: to the goal, mean over the settling ticks.
        costs: the best cost after every iteration [m], the first that of grips that come to rest.
        samples: motions rolled out.
    """

    displacements: Array
    points: Array
    distance_m: float
    costs: tuple[float, ...]
    samples: int


def search(
    predict: Predict,
    goal: Goal,
    limits: GripLimits,
    dt_s: float,
    config: MppiConfig,
    generator: np.random.Generator,
    *,
    progress: Callable[[int, int, float], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Found:
    """Search a motion.

    Args:
        predict: the model.
        goal: what to reach.
        limits: that every motion keeps.
        dt_s: the model's time step.
        config: of the search.
        generator: of the noise.
        progress: told (iterations done, of, best cost [m]).
        cancelled: asked before every batch; the search then raises Cancelled.

    Raises:
        UnstableSimulation: the model leaves the numbers although nothing moves; costs would be measured by that.
    """
    grips = len(limits.centres_m)
    mean = np.zeros((config.horizon, grips, 3))
    mean = best = limits.kept(mean, dt_s)  # the grips come to rest as fast as they may
    points = predict(dt_s * best[None].cumsum(axis=1))
    finite = np.isfinite(points[0]).all(axis=(1, 2))
    if not finite.all():
        raise UnstableSimulation(
            f"the model leaves the numbers {(np.argmin(finite) + 1) * dt_s:.3g} s after its start with grips that come "
            "to rest: nothing can be planned with it"
        )
    still = float(_ending(goal.distance(points), config)[0])
    best_cost = float(_costs(points, best[None], goal, limits, dt_s, config, still)[0])
    costs, best_points, drawn = [best_cost], points[0], 1
    widest = config.noise_share * limits.speed_m_s
    sigma = np.full((grips, 3), widest)
    for iteration in range(config.iterations):
        noise = sigma * coloured_noise(generator, (config.samples, config.horizon, grips, 3), config.colour)
        noise[0] = 0.0
        tried = limits.kept(mean + noise, dt_s)
        if iteration:
            tried[1] = best
        cost = np.empty(config.samples)
        for first in range(0, config.samples, config.chunk):
            if cancelled is not None and cancelled():
                raise Cancelled(f"planning cancelled in iteration {iteration}")
            some = tried[first : first + config.chunk]
            points = predict(dt_s * some.cumsum(axis=1))
            part = _costs(points, some, goal, limits, dt_s, config, still)
            cost[first : first + config.chunk] = part
            if part.min() < best_cost:
                winner = int(part.argmin())
                best_cost, best, best_points = float(part[winner]), some[winner].copy(), points[winner].copy()
        drawn += config.samples
        weights = _weights(cost, config.temperature)
        spread = np.einsum("k,ktgx->gx", weights, (tried - mean) ** 2) / config.horizon
        sigma = np.sqrt(config.noise_memory * sigma**2 + (1.0 - config.noise_memory) * spread)
        sigma = np.maximum(sigma, config.noise_floor * widest)
        mean = limits.kept(np.einsum("k,ktgx->tgx", weights, tried), dt_s)
        costs.append(best_cost)
        if progress is not None:
            progress(iteration + 1, config.iterations, best_cost)
    distance = float(_ending(goal.distance(best_points[None]), config)[0])
    return Found(dt_s * best.cumsum(axis=0), best_points, distance, tuple(costs), drawn)


def coloured_noise(generator: np.random.Generator, shape: tuple[int, ...], colour: float) -> Array:
    """Normal noise (K, T, …) whose power over axis 1 falls with 1/f^colour; variance 1 over the samples.

    It is cut from a longer period, so that its end does not return to its beginning.
    """
    ticks = shape[1]
    period = 2 * ticks
    frequency = np.fft.rfftfreq(period)
    frequency[0] = frequency[1]
    amplitude = frequency ** (-0.5 * colour)
    spectrum_shape = (shape[0], len(frequency), *shape[2:])
    spectrum = generator.normal(size=spectrum_shape) + 1j * generator.normal(size=spectrum_shape)
    spectrum *= amplitude.reshape(1, -1, *([1] * (len(shape) - 2)))
    noise = np.fft.irfft(spectrum, n=period, axis=1)[:, :ticks]
    return np.asarray(noise / noise.std())


def _costs(
    points: Array,
    velocities: Array,
    goal: Goal,
    limits: GripLimits,
    dt_s: float,
    config: MppiConfig,
    still: float,
) -> Array:
    """S of every motion [m]; infinite where the prediction is no number."""
    distance = goal.distance(np.where(np.isfinite(points), points, 1e6))
    first = np.broadcast_to(limits.started_m_s, (len(velocities), 1, *limits.started_m_s.shape))
    changes = np.diff(velocities, axis=1, prepend=first)
    effort = np.sqrt((changes**2).sum(axis=-1).mean(axis=(1, 2))) / limits.speed_m_s
    total = _ending(distance, config) + config.path_share * distance.mean(axis=1)
    total = total + config.effort_share * still * effort
    return np.where(np.isfinite(points).all(axis=(1, 2, 3)), total, np.inf)


def _ending(distance: Array, config: MppiConfig) -> Array:
    mean: Array = distance[:, -config.settling :].mean(axis=1)
    return mean


def _weights(cost: Array, temperature: float) -> Array:
    better = np.sort(cost[np.isfinite(cost)])[: max(2, len(cost) // 2)]
    if len(better) < 2:
        alone: Array = (cost == cost.min()) / (cost == cost.min()).sum()
        return alone
    scale = max(temperature * float(better.std()), 1e-12)
    weights = np.exp(-np.minimum((cost - better[0]) / scale, 700.0))
    return np.asarray(weights / weights.sum())
