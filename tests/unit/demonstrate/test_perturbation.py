"""The property field against the exact dense covariance, its continuity and its bounds."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.demonstrate.perturbation import (
    BOUND_SIGMAS,
    PropertyField,
    bounded,
    farthest_points,
    perturb_properties,
    similarity,
)
from physworld.geometry.features import part_features

DRAWS = 40_000
SAMPLING_ERROR = 5.0 / np.sqrt(DRAWS)  # five standard errors of an empirical correlation


def rope(count: int = 60) -> np.ndarray:
    points = np.zeros((count, 3))
    points[:, 0] = np.linspace(0.0, 1.0, count)
    return points


def draws(field: PropertyField, count: int, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return np.stack([field.sample(generator) for _ in range(count)])


def test_similarity_is_the_papers_kernel():
    first, second = np.array([[0.0, 0.0], [1.0, 2.0]]), np.array([[0.0, 0.0], [0.5, 0.5], [1.0, 2.0]])
    expected = [[np.exp(-np.sum((a - b) ** 2) / (2 * 0.7**2)) for b in second] for a in first]
    np.testing.assert_allclose(similarity(first, second, 0.7), expected, rtol=1e-12)


def test_with_every_particle_a_landmark_the_factor_is_exact():
    features = part_features(rope(40), 4)
    field = PropertyField(features, 0.5, landmarks=40)
    # eigenvalues below 1e-9 of the largest are left out
    np.testing.assert_allclose(field.factor @ field.factor.T, similarity(features, features, 0.5), atol=1e-7)
    assert abs(field.unresolved) < 1e-7


def test_the_empirical_covariance_of_nystroem_samples_is_the_dense_one():
    features = part_features(rope(), 4)
    field = PropertyField(features, 0.5, landmarks=16)
    assert field.factor.shape[1] <= 16
    empirical = np.cov(draws(field, DRAWS), rowvar=False)
    exact = similarity(features, features, 0.5)
    assert np.abs(empirical - exact).max() < SAMPLING_ERROR + 2.0 * field.unresolved
    assert field.unresolved < 0.02


def test_particles_keep_unit_variance_with_few_landmarks():
    field = PropertyField(part_features(rope(), 6), 0.2, landmarks=5)
    np.testing.assert_allclose(np.sum(field.factor**2, axis=1), 1.0, atol=1e-12)
    assert field.unresolved > 0.0


def test_properties_are_continuous_along_the_body():
    features = part_features(rope(400), 6)
    generator = np.random.default_rng(1)
    for _ in range(20):
        field = perturb_properties(features, generator, sigma_modulus=0.3, sigma_density=0.1)
        assert field.shape == (400, 2)
        # E|δ_i - δ_j|² = 2σ²(1 - S_ij) ≈ σ²|F_i - F_j|²/ℓ²: neighbours differ by their feature distance,
        # times a normal number that stays below 6 in these 20 x 399 draws
        steps = np.linalg.norm(np.diff(features, axis=0), axis=1)
        assert np.all(np.abs(np.diff(field[:, 0])) <= 6.0 * 0.3 * steps)
        assert np.all(np.abs(np.diff(field[:, 1])) <= 6.0 * 0.1 * steps)


def test_samples_are_bounded_positive_factors():
    features = part_features(rope(30), 4)
    generator = np.random.default_rng(2)
    fields = np.stack(
        [
            perturb_properties(features, generator, sigma_modulus=0.5, sigma_density=0.2, length_scale=0.3)
            for _ in range(2000)
        ]
    )
    assert np.abs(fields[..., 0]).max() < BOUND_SIGMAS * 0.5
    assert np.abs(fields[..., 1]).max() < BOUND_SIGMAS * 0.2
    assert np.all(np.exp(fields) > 0.0)
    # the bound takes 2.5 % off the standard deviation
    assert fields[..., 0].std() == pytest.approx(0.5, rel=0.05)
    assert abs(np.corrcoef(fields[:, 7, 0], fields[:, 7, 1])[0, 1]) < 5.0 / np.sqrt(2000)


def test_the_bound_is_smooth_and_odd():
    x = np.linspace(-8.0, 8.0, 16_001)
    y = bounded(x)
    np.testing.assert_allclose(y[np.abs(x) <= 2.0], x[np.abs(x) <= 2.0])
    np.testing.assert_allclose(y, -y[::-1], atol=1e-12)
    slope = np.diff(y) / np.diff(x)
    assert np.all(slope >= 0.0)
    assert np.abs(np.diff(slope)).max() < 2e-3  # no jump in the slope at ±2
    assert np.abs(y).max() <= BOUND_SIGMAS


def test_zero_sigma_changes_nothing_and_equal_seeds_agree():
    features = part_features(rope(20), 3)
    still = perturb_properties(features, np.random.default_rng(0), sigma_modulus=0.0, sigma_density=0.0)
    assert not still.any()
    one, two = (
        perturb_properties(features, np.random.default_rng(9), sigma_modulus=0.2, sigma_density=0.1)
        for _ in range(2)
    )
    np.testing.assert_array_equal(one, two)


def test_features_without_distance_give_one_common_factor():
    generator = np.random.default_rng(0)
    field = perturb_properties(np.zeros((7, 4)), generator, sigma_modulus=0.2, sigma_density=0.1)
    np.testing.assert_allclose(field, np.broadcast_to(field[0], field.shape))


def test_farthest_points_spread():
    chosen = farthest_points(rope(101), 3)
    np.testing.assert_array_equal(np.sort(chosen), [0, 50, 100])


def test_unfit_features_are_refused():
    with pytest.raises(ValueError, match="must be finite"):
        PropertyField(np.array([[np.nan]]), 1.0)
    with pytest.raises(ValueError, match="length scale 0 is not positive"):
        PropertyField(np.zeros((2, 1)), 0.0)
