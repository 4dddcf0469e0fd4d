"""Intervals by blocks of frames, and what a new recording says of a model."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.estimation.blocks import (
    AS_EXPECTED,
    WITHIN_NOISE,
    WORSE,
    compare,
    mean_with_interval,
    paired_gain,
)


def correlated(rng: np.random.Generator, count: int, mean: float) -> np.ndarray:
    """Errors whose neighbours resemble each other."""
    noise = np.convolve(rng.normal(size=count + 4), np.ones(5) / 5, mode="valid")
    return mean * (1.0 + 0.3 * noise)


def test_an_interval_holds_the_mean_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(3)
    found = [mean_with_interval(correlated(rng, 100, 1.0), seed=k).ci95 for k in range(60)]
    held = np.mean([low <= 1.0 <= high for low, high in found])
    assert 0.8 <= held <= 1.0
    assert np.mean([high - low for low, high in found]) < 0.2


def test_frames_without_an_error_do_not_count() -> None:
    curve = np.array([1.0, np.nan, 3.0, np.nan])
    mean = mean_with_interval(curve)
    assert (mean.value, mean.frames) == (2.0, 2)
    with pytest.raises(ValueError, match="none of 3 frames"):
        mean_with_interval(np.full(3, np.nan))


def test_a_gain_that_all_frames_share_is_certain_though_the_errors_differ() -> None:
    before = np.linspace(1.0, 9.0, 50)
    gain = paired_gain(before, before - 0.5)
    assert gain.value == pytest.approx(0.5)
    assert gain.ci95 == pytest.approx((0.5, 0.5))


def test_outcomes_follow_noise_promise_and_excess() -> None:
    rng = np.random.default_rng(5)
    promised = correlated(rng, 100, 3e-3)
    assert compare(correlated(rng, 80, 1e-3), 1.1e-3, promised, 1e-3).outcome == WITHIN_NOISE
    same = compare(correlated(rng, 80, 3e-3), 1e-3, promised, 1e-3)
    assert same.outcome == AS_EXPECTED
    assert same.excess_ci95[0] <= 0.0 <= same.excess_ci95[1]
    better = compare(correlated(rng, 80, 2e-3), 1e-3, promised, 1e-3)
    assert better.outcome == AS_EXPECTED and better.excess < 0.0
    worse = compare(correlated(rng, 80, 6e-3), 1e-3, promised, 1e-3)
    assert worse.outcome == WORSE and worse.excess_ci95[0] > 0.0


def test_a_noisier_camera_is_no_worse_model() -> None:
    rng = np.random.default_rng(7)
    promised = correlated(rng, 100, 2e-3)
    noisy = np.sqrt(correlated(rng, 80, 2e-3) ** 2 + 6e-3**2)
    assert compare(noisy, 6e-3, promised, 0.0).outcome != WORSE
    assert compare(noisy, 0.0, promised, 0.0).outcome == WORSE
