"""The property field against the exact dense covariance, its continuity and its bounds."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.demonstrate.perturbation import (
    BOUND_SIGMAS,
    PropertyField,
    bounded,
    check_field,
    farthest_points,
    perturb,
    similarity,
    with_space,
)
from physworld.errors import UnstableSimulation
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
    law = PropertyField(features, 1.0)
    generator = np.random.default_rng(1)
    for _ in range(20):
        field = perturb("p3", 0.3, 400, law, generator)
        assert field.shape == (400,)
        # E|δ_i - δ_j|² = 2σ²(1 - S_ij) ≈ σ²|F_i - F_j|²/ℓ²: neighbours differ by their feature distance,
        # times a normal number that stays below 6 in these 20 x 399 draws
        steps = np.linalg.norm(np.diff(features, axis=0), axis=1)
        assert np.all(np.abs(np.diff(field)) <= 6.0 * 0.3 * steps)


def test_samples_are_bounded_positive_factors():
    law = PropertyField(part_features(rope(30), 4), 0.3)
    generator = np.random.default_rng(2)
    fields = np.stack([perturb("p3", 0.5, 30, law, generator) for _ in range(4000)])
    assert np.abs(fields).max() < BOUND_SIGMAS * 0.5
    # the bound takes 2.5 % off the standard deviation
    assert fields.std() == pytest.approx(0.5, rel=0.05)
    first, second = fields[::2, 7], fields[1::2, 7]
    assert abs(np.corrcoef(first, second)[0, 1]) < 5.0 / np.sqrt(2000)


def test_no_factor_passes_the_largest_one():
    law = PropertyField(part_features(rope(30), 4), 0.3)
    generator = np.random.default_rng(3)
    fields = np.stack([perturb("p3", 2.0, 30, law, generator, largest_factor=4.0) for _ in range(200)])
    assert np.abs(fields).max() <= np.log(4.0)
    assert np.abs(fields).max() > 0.9 * np.log(4.0)


def test_the_baselines_are_one_draw_for_all_and_one_for_each():
    generator = np.random.default_rng(4)
    uniform = np.stack([perturb("uniform", 0.2, 9, None, generator) for _ in range(500)])
    assert not np.ptp(uniform, axis=1).any()
    assert uniform[:, 0].std() == pytest.approx(0.2, rel=0.15)
    alone = np.stack([perturb("random", 0.2, 9, None, generator) for _ in range(3000)])
    correlation = np.corrcoef(alone, rowvar=False)
    assert np.abs(correlation - np.eye(9)).max() < 5.0 / np.sqrt(3000)
    assert alone.std() == pytest.approx(0.2, rel=0.05)
    assert not perturb("none", 0.2, 9, None, generator).any()
    with pytest.raises(ValueError, match="unknown perturbation 'wild'"):
        perturb("wild", 0.2, 9, None, generator)
    with pytest.raises(ValueError, match="needs a field"):
        perturb("p3", 0.2, 9, None, generator)


def test_landmarks_are_added_until_they_resolve_the_field():
    features = part_features(rope(300), 6)
    few = PropertyField(features, 0.15, landmarks=4)
    enough = PropertyField(features, 0.15, landmarks=4, unresolved=0.02)
    assert few.landmarks == 4 and few.unresolved > 0.02
    assert enough.landmarks > 4 and enough.unresolved <= 0.02


def test_a_kernel_of_features_and_space_is_their_product():
    features, points = part_features(rope(), 3), rope()
    joined = with_space(features, points, 0.7, 0.2)
    product = similarity(features, features, 0.7) * similarity(points, points, 0.2)
    np.testing.assert_allclose(similarity(joined, joined, 0.7), product, rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match="length scale in space 0 m"):
        with_space(features, points, 0.7, 0.0)


def test_a_field_that_jumps_or_passes_its_bounds_is_refused_with_its_numbers():
    law = PropertyField(part_features(rope(), 4), 0.5)
    pairs = np.stack([np.arange(59), np.arange(1, 60)], axis=1)
    values = perturb("p3", 0.2, 60, law, np.random.default_rng(5))
    assert 0.0 < check_field(values, 0.2, pairs, law) < 0.5
    torn = values.copy()
    torn[30:] = np.where(values[30] > 0.0, -0.5, 0.5)
    with pytest.raises(UnstableSimulation, match=r"particles \[29, 30\] side by side differ by 0\.[0-9]+"):
        check_field(torn, 0.2, pairs, law)
    with pytest.raises(
        UnstableSimulation, match=r"exp\(0\.7000\) times its fitted value, the bound is exp\(0\.6"
    ):
        check_field(np.full(60, 0.7), 0.2, pairs, law)
    with pytest.raises(UnstableSimulation, match="1 of 60 properties are not finite"):
        check_field(np.where(np.arange(60) == 3, np.nan, 0.0), 0.2, pairs, law)


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
    law = PropertyField(part_features(rope(20), 3), 1.0)
    assert not perturb("p3", 0.0, 20, law, np.random.default_rng(0)).any()
    one, two = (perturb("p3", 0.2, 20, law, np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(one, two)


def test_features_without_distance_give_one_common_factor():
    field = perturb("p3", 0.2, 7, PropertyField(np.zeros((7, 4)), 1.0), np.random.default_rng(0))
    np.testing.assert_allclose(field, np.broadcast_to(field[0], field.shape))


def test_farthest_points_spread():
    chosen = farthest_points(rope(101), 3)
    np.testing.assert_array_equal(np.sort(chosen), [0, 50, 100])


def test_unfit_features_are_refused():
    with pytest.raises(ValueError, match="must be finite"):
        PropertyField(np.array([[np.nan]]), 1.0)
    with pytest.raises(ValueError, match="length scale 0 is not positive"):
        PropertyField(np.zeros((2, 1)), 0.0)
