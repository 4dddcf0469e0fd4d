"""Intervals on errors over time by resampling blocks of neighbouring frames.

Errors of neighbouring frames are not independent, so frames are drawn in runs (Kuensch 1989, the moving-block
bootstrap), of about the square root of their number. A few blocks show less spread than there is: deviations are
widened to what Student's t says for their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from physworld.arrays import Array

RESAMPLES = 2000
_SHORTEST_BLOCK = 3
_TAILS = (0.025, 0.975)

WITHIN_NOISE, AS_EXPECTED, WORSE = "within_noise", "as_expected", "worse_than_expected"


@dataclass(frozen=True)
class Mean:
    """A mean error [m] over the frames that have one, with its 95 % interval."""

    value: float
    ci95: tuple[float, float]
    frames: int


@dataclass(frozen=True)
class Comparison:
    """What a new recording says of a model.

    Attributes:
        outcome: ``within_noise``: the error does not exceed what noise alone shows; ``as_expected``: nor, noise taken
            off both, the error that the model promised; else ``worse_than_expected``.
        measured, expected: mean errors on the new recording, and on the frames that the model promised by.
        excess: difference of the errors, noise taken off each in squares [m]; above zero: worse.
        excess_ci95: its 95 % interval.
    """

    outcome: str
    measured: Mean
    expected: Mean
    excess: float
    excess_ci95: tuple[float, float]


def mean_with_interval(curve: Array, seed: int = 0) -> Mean:
    """Mean of an error curve (F,) [m]; NaN where a frame has no error. Raises ValueError when none has."""
    seen = _seen(curve)
    value = float(seen.mean())
    ends = np.quantile(_means(seen, seed), _TAILS)
    factor = _widening(len(seen))
    if seen.min() > 0.0:  # errors: widened as factors, so that no interval reaches below zero
        low, high = value * (ends / value) ** factor
    else:
        low, high = value + factor * (ends - value)
    return Mean(value, (float(low), float(high)), len(seen))


def paired_gain(before: Array, after: Array, seed: int = 0) -> Mean:
    """Mean of ``before - after`` (F,) [m], the same frames drawn for both; above zero: after is better."""
    return mean_with_interval(np.asarray(before, dtype=float) - np.asarray(after, dtype=float), seed)


def compare(
    measured: Array,
    measured_floor: float | None,
    expected: Array,
    expected_floor: float | None,
    seed: int = 0,
) -> Comparison:
    """Hold the errors of a new recording (F,) [m] against those that a model promised (G,) [m].

    Args:
        measured_floor, expected_floor: what noise alone shows [m]; None where it is not known: no noise is assumed.
    """
    new, old = mean_with_interval(measured, seed), mean_with_interval(expected, seed)
    floors = (measured_floor or 0.0, expected_floor or 0.0)
    draws = [
        _without_noise(_means(_seen(curve), seed + k), floor)
        for k, (curve, floor) in enumerate(zip((measured, expected), floors, strict=True))
    ]
    excess = float(_without_noise(new.value, floors[0]) - _without_noise(old.value, floors[1]))
    ends = np.quantile(draws[0] - draws[1], _TAILS)
    low, high = excess + _widening(min(new.frames, old.frames)) * (ends - excess)
    if new.ci95[0] <= floors[0]:
        outcome = WITHIN_NOISE
    else:
        outcome = AS_EXPECTED if low <= 0.0 else WORSE
    return Comparison(outcome, new, old, excess, (float(low), float(high)))


def _without_noise(error: Array | float, floor: float) -> Array:
    """What remains of a mean error when noise is taken off in squares [m]."""
    remainder: Array = np.sqrt(np.maximum(np.square(error) - floor**2, 0.0))
    return remainder


def _seen(curve: Array) -> Array:
    values = np.asarray(curve, dtype=float)
    seen: Array = values[np.isfinite(values)]
    if not len(seen):
        raise ValueError(f"none of {len(values)} frames has an error")
    return seen


def _length(count: int) -> int:
    """Frames in a block; single frames where there are too few for two blocks."""
    return max(_SHORTEST_BLOCK, round(count**0.5)) if count > _SHORTEST_BLOCK else 1


def _widening(count: int) -> float:
    """Factor on the deviations of resampled means of ``count`` frames."""
    blocks = max(count / _length(count), 1.5)
    return float(stdtrit(blocks - 1, _TAILS[1]) / ndtri(_TAILS[1]) * (blocks / (blocks - 1)) ** 0.5)


def _means(values: Array, seed: int) -> Array:
    """Means of resamples of whole length, (RESAMPLES,)."""
    count = len(values)
    length = _length(count)
    starts = np.random.default_rng(seed).integers(0, count - length + 1, (RESAMPLES, -(-count // length)))
    picked = (starts[..., None] + np.arange(length)).reshape(RESAMPLES, -1)[:, :count]
    return np.asarray(values[picked].mean(axis=1))
