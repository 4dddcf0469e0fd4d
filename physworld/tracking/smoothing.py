"""Paths without the noise of their measurement: a state-space smoother whose stiffness the data choose.

Each channel is a place, its velocity and its acceleration, which chance changes (a thrice integrated white noise), seen
through white noise of known deviation: a smoothing spline of degree five, as a Kalman filter and its backward pass
(Rauch, Tung & Striebel 1965). How much chance there is maximises the likelihood. Where nothing was seen the path goes
on as it went, and its uncertainty grows.

What is left uncertain is told as draws: paths that are as likely as the smoothed one, correlated in time as its errors
are (Durbin & Koopman 2002).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from physworld.arrays import Array

_MEDIAN_OF_NORMAL = 0.6745
_FIFTH = 252.0  # sum of squares of 1, -5, 10, -10, 5, -1
_FEWEST = 10  # differences that tell a deviation
_STIFFNESS = (-30.0, 10.0)  # logarithm of the chance in a frame over the noise, squared
_DIFFUSE = 1e9
_STEP = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
_CHANCE = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])


@dataclass(frozen=True)
class Smoothed:
    """A path without noise.

    Attributes:
        values: (T, C).
        deviations: of them, (T, C).
        draws: as likely paths, (S, T, C).
    """

    values: Array
    deviations: Array
    draws: Array


def white_deviation(values: Array, seen: Array) -> Array | None:
    """Deviation of white noise in every channel, (C,); None where too few frames running are seen.

    Fifth differences: what moves by 5 cm once a second leaves a thousandth of that at 30 frames a second.

    Args:
        values: (T, C).
        seen: (T,) bool.
    """
    known = seen.copy()
    fifth = np.diff(np.where(seen[:, None], values, 0.0), n=5, axis=0)
    running = np.stack([known[k : len(known) - 5 + k] for k in range(6)]).all(axis=0)
    if running.sum() < _FEWEST:
        return None
    found: Array = np.median(np.abs(fifth[running]), axis=0) / (_MEDIAN_OF_NORMAL * _FIFTH**0.5)
    return found


def smoothed(values: Array, deviations: Array, seen: Array, draws: int, rng: np.random.Generator) -> Smoothed:
    """The path behind measurements.

    Args:
        values: (T, C); not read where not seen.
        deviations: of their noise, (T, C), positive where seen.
        seen: (T,) bool, at least three of them.
        draws: S.
        rng: of the draws.
    """
    channels = [_Channel(values[:, k], deviations[:, k], seen) for k in range(values.shape[1])]
    means, spreads = (np.stack(part, axis=1) for part in zip(*(c.smooth() for c in channels), strict=True))
    return Smoothed(means, spreads, np.stack([channel.draws(draws, rng) for channel in channels], axis=2))


class _Channel:
    """One channel with the likeliest chance."""

    def __init__(self, values: Array, deviations: Array, seen: Array) -> None:
        self._seen = seen
        self._unit = float(np.median(deviations[seen]))
        self._values = np.where(seen, values, 0.0) / self._unit
        self._variances = np.where(seen, deviations / self._unit, 1.0) ** 2
        self._middle = float(np.mean(self._values[seen]))
        best = minimize_scalar(self._unlikely, bounds=_STIFFNESS, method="bounded", options={"xatol": 0.05})
        self._chance = float(np.exp(best.x))

    def smooth(self) -> tuple[Array, Array]:
        """Places and their deviations, (T,) each."""
        gains = self._gains(self._chance)
        return (
            self._through(gains, self._values[None] - self._middle)[0] + self._middle
        ) * self._unit, np.sqrt(np.maximum(gains[-1], 0.0)) * self._unit

    def draws(self, count: int, rng: np.random.Generator) -> Array:
        """As likely paths, (S, T)."""
        root = np.linalg.cholesky(_CHANCE * self._chance)
        state = np.zeros((count, 3))
        moved = np.empty((count, len(self._values)))
        for frame in range(len(self._values)):
            if frame:
                state = state @ _STEP.T + rng.normal(size=(count, 3)) @ root.T
            moved[:, frame] = state[:, 0]
        noisy = moved + rng.normal(size=moved.shape) * np.sqrt(self._variances)
        gains = self._gains(self._chance)
        found = self._through(gains, self._values[None] - self._middle) + moved - self._through(gains, noisy)
        return (found + self._middle) * self._unit

    def _unlikely(self, log_chance: float) -> float:
        """Minus twice the logarithm of the likelihood, but for a constant; the first three sights place the path."""
        chance = _CHANCE * np.exp(log_chance)
        state, spread = np.zeros(3), _DIFFUSE * np.eye(3)
        total, counted = 0.0, 0
        for frame in range(len(self._values)):
            if frame:
                state, spread = _STEP @ state, _STEP @ spread @ _STEP.T + chance
            if not self._seen[frame]:
                continue
            expected = spread[0, 0] + self._variances[frame]
            miss = self._values[frame] - self._middle - state[0]
            gain = spread[:, 0] / expected
            state, spread = state + gain * miss, spread - np.outer(gain, spread[0])
            counted += 1
            if counted > 3:
                total += np.log(expected) + miss**2 / expected
        return float(total)

    def _gains(self, chance: float) -> tuple[Array, Array, Array]:
        """Gains of the filter (T, 3) and of the backward pass (T - 1, 3, 3), and the places' variances (T,)."""
        frames = len(self._values)
        forward, spreads, before = np.zeros((frames, 3)), np.empty((frames, 3, 3)), np.empty((frames, 3, 3))
        spread = _DIFFUSE * np.eye(3)
        for frame in range(frames):
            if frame:
                spread = _STEP @ spread @ _STEP.T + _CHANCE * chance
            before[frame] = spread
            if self._seen[frame]:
                forward[frame] = spread[:, 0] / (spread[0, 0] + self._variances[frame])
                spread = spread - np.outer(forward[frame], spread[0])
            spreads[frame] = spread
        backward = np.empty((frames - 1, 3, 3))
        variances = np.empty(frames)
        later = spreads[-1]
        variances[-1] = later[0, 0]
        for frame in range(frames - 2, -1, -1):
            backward[frame] = np.linalg.solve(before[frame + 1], _STEP @ spreads[frame]).T
            later = spreads[frame] + backward[frame] @ (later - before[frame + 1]) @ backward[frame].T
            variances[frame] = later[0, 0]
        return forward, backward, variances

    def _through(self, gains: tuple[Array, Array, Array], values: Array) -> Array:
        """Smoothed places of series (S, T) about zero."""
        forward, backward, _ = gains
        count, frames = values.shape
        state, states, expected = (
            np.zeros((count, 3)),
            np.empty((frames, count, 3)),
            np.empty((frames, count, 3)),
        )
        for frame in range(frames):
            if frame:
                state = state @ _STEP.T
            expected[frame] = state
            if self._seen[frame]:
                state = state + (values[:, frame] - state[:, 0])[:, None] * forward[frame]
            states[frame] = state
        later = states[-1]
        found = np.empty((count, frames))
        found[:, -1] = later[:, 0]
        for frame in range(frames - 2, -1, -1):
            later = states[frame] + (later - expected[frame + 1]) @ backward[frame].T
            found[:, frame] = later[:, 0]
        return found
