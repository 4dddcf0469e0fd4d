"""Intervals hold the truth about as often as they say, with the noise of frame 0 that places the points."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.verification.calibration_known import BAR_PA, SIGMA_M, bar, linear_draw, predicted
from physworld.calibrate.discretisation import converged_parameters
from physworld.calibrate.estimates import Correlations, Estimate
from physworld.calibrate.global_stage import FitResult
from physworld.calibrate.parameters import parameters_of
from physworld.estimation.least_squares import Solution, block_covariance, correlations
from physworld.evaluate.numerics import refined
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

DRAWS, COVERED = 100, 90
BUDGET = 500  # particles of the coarse twin
NAMES, STEPS = ("youngs_modulus_pa", "air_drag_per_s"), (0.02, 0.1)


def sensitivities() -> np.ndarray:
    """Of the bar's tracks over its training frames to the logarithms of modulus and drag, (T, N, 3, 2)."""
    twin, scene = bar()
    tracks = predicted(twin, scene)
    columns = [
        (predicted(twin.with_parameters(**{name: twin.parameters[name] * np.exp(step)}), scene) - tracks)
        / step
        for name, step in zip(NAMES, STEPS, strict=True)
    ]
    return np.stack(columns, axis=-1)[1 : scene.train[1]]


def test_at_least_90_of_100_linearised_draws_are_covered() -> None:
    jacobian, rng = sensitivities(), np.random.default_rng(0)
    hits = np.sum([linear_draw(jacobian, SIGMA_M, rng) for _ in range(DRAWS)], axis=0)
    assert np.all(hits >= COVERED)


def test_intervals_are_not_merely_wide() -> None:
    """Ten times the noise that the interval has seen falls outside of it."""
    jacobian = sensitivities()
    design = jacobian.reshape(-1, 2)
    rng = np.random.default_rng(1)
    residual = rng.normal(scale=SIGMA_M, size=len(design))
    frame = np.repeat(np.arange(len(jacobian)), jacobian.shape[1] * 3)
    half = 2.3 * np.sqrt(np.diag(block_covariance(Solution(np.zeros(2), 1.0, residual, design), frame)))
    spread = np.sqrt(np.diag(SIGMA_M**2 * np.linalg.inv(design.T @ design)))
    assert np.all(half < 6 * spread)


def test_correlations_are_those_of_the_sensitivities() -> None:
    rng = np.random.default_rng(2)
    design = rng.normal(size=(400, 2)) @ np.array([[1.0, 0.9], [0.0, np.sqrt(1 - 0.81)]])
    solution = Solution(np.zeros(2), 1.0, rng.normal(size=400), design)
    matrix = correlations(block_covariance(solution, np.repeat(np.arange(40), 10)))
    assert matrix[0, 1] == pytest.approx(-0.9, abs=0.05)  # alike in effect: one makes up for the other
    assert matrix[1, 0] == pytest.approx(matrix[0, 1])
    np.testing.assert_allclose(np.diag(matrix), 1.0)


def test_one_number_a_point_is_seen_by_the_clusters_of_points() -> None:
    """Errors that stay with a tracked point through all frames widen the interval of what they resemble."""
    rng = np.random.default_rng(3)
    frames, points = 60, 20
    frame, point = np.repeat(np.arange(frames), points), np.tile(np.arange(points), frames)
    design = rng.normal(size=points)[point][:, None]
    residual = rng.normal(size=points)[point] + 0.1 * rng.normal(size=len(point))
    residual -= design[:, 0] * (design[:, 0] @ residual) / (design[:, 0] @ design[:, 0])
    solution = Solution(np.zeros(1), 1.0, residual, design)
    blind = np.sqrt(block_covariance(solution, frame)[0, 0])
    seeing = np.sqrt(block_covariance(solution, frame, point)[0, 0])
    assert seeing == pytest.approx(1.0 / np.sqrt(points), rel=0.5)
    assert blind < 0.3 * seeing


def test_the_lattice_s_error_is_extrapolated_away() -> None:
    """A coarse twin that matches a finer one needs another modulus; the extrapolation gives back the finer one's."""
    _, scene = bar()
    twin = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=BAR_PA)
    finer = refined(scene, twin, BUDGET, 2.0)
    stiffness = next(p for p in parameters_of(twin, False) if p.name == NAMES[0])
    tracks, target = predicted(twin, scene), predicted(finer, scene)
    moved = predicted(twin.with_parameters(youngs_modulus_pa=BAR_PA * np.exp(0.02)), scene) - tracks
    window = slice(1, scene.train[1])
    gain = moved[window].ravel() / 0.02
    effective = BAR_PA * np.exp(float(gain @ (target - tracks)[window].ravel()) / float(gain @ gain))
    assert abs(effective / BAR_PA - 1) > 3e-3, effective  # the coarse lattice does err here
    coarse = twin.with_parameters(youngs_modulus_pa=effective)
    fitted = FitResult(
        twin=coarse,
        parameters={NAMES[0]: Estimate(effective, "Pa", (0.99 * effective, 1.01 * effective))},
        searched=(stiffness,),
        correlations=Correlations((NAMES[0],), np.eye(1)),
        tracks=predicted(coarse, scene),
        particles=np.zeros((0, 0, 3)),
        losses={},
        simulations=0,
        seconds=0.0,
        loss_history=[],
    )
    found = converged_parameters(scene, fitted, BUDGET)[NAMES[0]]
    left = np.log(effective / BAR_PA) / 3  # of second order, half the cell size leaves a quarter of the error
    assert found.value == pytest.approx(BAR_PA * np.exp(-left), rel=0.007)
    assert found.value != pytest.approx(effective, rel=0.014)
    assert found.ci95 is not None and found.ci95[0] < found.value < found.ci95[1]
    assert f"{effective:.5g}" in found.note


def test_an_interval_that_holds_zero_keeps_its_width_without_the_lattices_error() -> None:
    _, scene = bar()
    twin = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=BAR_PA)
    ratio = next(p for p in parameters_of(twin, False) if p.name == "poissons_ratio")
    fitted = FitResult(
        twin=twin,
        parameters={ratio.name: Estimate(0.3, "1", (-0.1, 0.7))},
        searched=(ratio,),
        correlations=Correlations((ratio.name,), np.eye(1)),
        tracks=predicted(twin, scene),
        particles=np.zeros((0, 0, 3)),
        losses={},
        simulations=0,
        seconds=0.0,
        loss_history=[],
    )
    found = converged_parameters(scene, fitted, BUDGET)[ratio.name]
    assert found.ci95 is not None
    assert found.ci95[1] - found.ci95[0] >= 0.8 * (1 - 1e-9) and np.isfinite(found.ci95).all()
