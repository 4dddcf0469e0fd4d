"""The search against problems whose optimum is known, and its intervals against repeated experiments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from physworld.estimation.least_squares import Solution, block_covariance, descent, interval_factor

STEPS = np.array([1e-3, 1e-3])
LOW, HIGH = np.full(2, -5.0), np.full(2, 5.0)


def gauss_newton(residual: Callable[[np.ndarray], np.ndarray], *asked: Any) -> Solution:
    """A descent whose residuals are computed at once."""
    asking = descent(*asked)
    needed, _ = next(asking)
    while True:
        try:
            needed, _ = asking.send([residual(one) for one in needed])
        except StopIteration as ended:
            found: Solution = ended.value
            return found


def line(theta: np.ndarray) -> np.ndarray:
    """Residual of a line through four points, linear in theta; optimum (0.7, -1.1) up to a rest of its own."""
    design = np.array([[1.0, -1.5], [1.0, -0.5], [1.0, 0.5], [1.0, 1.5]])
    rest = 0.2 * np.array([1.0, -1.0, -1.0, 1.0])  # orthogonal to both columns
    return design @ (theta - np.array([0.7, -1.1])) + rest


def test_a_quadratic_is_solved_and_its_cost_is_the_rest() -> None:
    found = gauss_newton(line, np.zeros(2), LOW, HIGH, STEPS, 8)
    np.testing.assert_allclose(found.theta, [0.7, -1.1], atol=1e-4)
    assert found.cost == pytest.approx(0.04, rel=1e-5)
    np.testing.assert_allclose(found.residual, line(found.theta))
    np.testing.assert_allclose(found.jacobian[:, 1], [-1.5, -0.5, 0.5, 1.5], atol=1e-9)


def test_a_start_that_cannot_be_simulated_is_returned_and_nothing_else_is_tried() -> None:
    visited: list[np.ndarray] = []

    def blown_up(theta: np.ndarray) -> np.ndarray:
        visited.append(theta)
        return np.full(4, np.nan)

    found = gauss_newton(blown_up, np.array([0.5, 0.25]), LOW, HIGH, STEPS, 8)
    np.testing.assert_array_equal(found.theta, [0.5, 0.25])
    assert np.isnan(found.cost) and len(visited) == 1


def test_a_curved_basin_is_followed() -> None:
    def rosenbrock(theta: np.ndarray) -> np.ndarray:
        return np.array([10 * (theta[1] - theta[0] ** 2), 1 - theta[0]])

    found = gauss_newton(rosenbrock, np.array([-1.2, 1.0]), LOW, HIGH, STEPS * 1e-3, 60)
    np.testing.assert_allclose(found.theta, [1.0, 1.0], atol=1e-3)


def test_an_optimum_beyond_the_bounds_ends_at_the_bound() -> None:
    high = np.array([0.5, 5.0])
    found = gauss_newton(line, np.array([0.5, 0.0]), LOW, high, STEPS, 10)
    np.testing.assert_allclose(found.theta, [0.5, -1.1], atol=1e-3)


def test_a_start_outside_the_bounds_is_brought_inside_and_never_left() -> None:
    visited: list[np.ndarray] = []

    def watched(theta: np.ndarray) -> np.ndarray:
        visited.append(theta.copy())
        return line(theta)

    gauss_newton(watched, np.array([90.0, -90.0]), LOW, HIGH, STEPS, 10)
    assert np.all(np.array(visited) >= LOW) and np.all(np.array(visited) <= HIGH)


def test_steps_into_a_region_that_blows_up_are_shortened() -> None:
    def walled(theta: np.ndarray) -> np.ndarray:
        residual = np.array([np.exp(3 * theta[0]) - 2.0])
        return residual if theta[0] < 0.4 else np.full(1, np.nan)

    found = gauss_newton(walled, np.array([-0.7]), np.full(1, -5.0), np.full(1, 5.0), np.full(1, 1e-3), 20)
    assert found.theta[0] == pytest.approx(np.log(2.0) / 3, abs=1e-3)


def test_a_start_that_blows_up_comes_back_with_its_cost_not_a_number() -> None:
    found = gauss_newton(lambda theta: np.full(3, np.nan), np.zeros(2), LOW, HIGH, STEPS)
    assert np.isnan(found.cost) and np.isfinite(found.theta).all() and np.isfinite(found.jacobian).all()


def test_a_derivative_that_blows_up_counts_as_none() -> None:
    def half_blind(theta: np.ndarray) -> np.ndarray:
        return line(theta) if theta[1] <= 0.0 else np.full(4, np.nan)

    found = gauss_newton(half_blind, np.zeros(2), LOW, HIGH, STEPS, 1)
    assert np.all(found.jacobian[:, 1] == 0.0)
    assert np.isfinite(found.cost) and found.cost <= np.mean(line(np.zeros(2)) ** 2)


def test_a_flat_cost_stays_where_it_is() -> None:
    found = gauss_newton(lambda theta: np.ones(4), np.array([0.3, 0.4]), LOW, HIGH, STEPS)
    np.testing.assert_array_equal(found.theta, [0.3, 0.4])


def covered(correlated: bool, repeats: int = 400, frames: int = 100, points: int = 5) -> float:
    """Share of experiments whose 95 % interval of the slope holds the truth."""
    rng = np.random.default_rng(7)
    frame = np.repeat(np.arange(frames), points)
    x = np.sin(0.4 * np.arange(frames))
    design = np.stack([np.repeat(x, points), np.ones(frames * points)], axis=1)
    hits = 0
    for _ in range(repeats):
        if correlated:  # neighbours within a twentieth of the frames go wrong together, all points alike
            shared = np.convolve(rng.normal(size=frames + 4), np.ones(5) / np.sqrt(5), mode="valid")
            noise = np.repeat(shared, points) + 0.3 * rng.normal(size=frame.size)
        else:
            noise = rng.normal(size=frame.size)
        theta = np.linalg.lstsq(design, noise, rcond=None)[0]  # truth: zero
        residual = design @ theta - noise
        solution = Solution(theta, float(np.mean(residual**2)), residual, design)
        half = interval_factor(frames, 2) * np.sqrt(block_covariance(solution, frame)[0, 0])
        hits += bool(abs(theta[0]) <= half)
    return hits / repeats


@pytest.mark.parametrize("correlated", [False, True])
def test_intervals_cover_the_truth_about_as_often_as_they_say(correlated: bool) -> None:
    assert 0.90 <= covered(correlated) <= 0.995  # ten blocks, 400 experiments: binomial error 1 %


def test_intervals_of_few_frames_are_still_numbers() -> None:
    solution = Solution(
        np.zeros(2),
        0.04,
        line(np.array([0.7, -1.1])),
        gauss_newton(line, np.zeros(2), LOW, HIGH, STEPS).jacobian,
    )
    covariance = block_covariance(solution, np.array([0, 0, 1, 1]))
    assert np.isfinite(covariance).all() and np.all(np.diag(covariance) >= -1e-30)


def test_the_factor_is_student_s_and_too_few_frames_give_no_interval() -> None:
    assert interval_factor(1000, 3) == interval_factor(10, 1) == pytest.approx(2.262, abs=1e-3)
    assert interval_factor(2, 1) == pytest.approx(12.706, abs=1e-3)
    assert interval_factor(3, 3) == np.inf
