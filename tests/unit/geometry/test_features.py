"""Spectral part features: chains against their closed form, necks, disconnected parts, few particles."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csgraph

from physworld.geometry.features import carry_features, neighbor_graph, part_features, standardise


def box(low: tuple[float, ...], high: tuple[float, ...], counts: tuple[int, ...]) -> np.ndarray:
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def rms_distance(features: np.ndarray) -> float:
    distances = np.linalg.norm(features[:, None] - features[None], axis=-1)
    return float(np.sqrt(np.mean(distances**2)))


def test_a_path_graph_has_the_cosines_of_its_closed_form():
    count = 40
    chain = np.zeros((count, 3))
    chain[:, 0] = np.arange(count)
    # two neighbours each: nearly a path graph, whose eigenvectors are cosines
    features = part_features(chain, 3, neighbors=2)
    mode = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    correlation = np.corrcoef(features[:, 0], mode)[0, 1]
    assert abs(correlation) > 0.995  # the second neighbours of the two ends bend it a little
    assert np.all(np.diff(features[:, 0] * np.sign(correlation)) < 0.0)


@pytest.mark.parametrize("count", [50, 1200])
def test_features_have_zero_mean_and_unit_scale_and_are_reproducible(count):
    points = np.random.default_rng(1).uniform(size=(count, 3)) * [1.0, 0.4, 0.3]
    features = part_features(points, 6)
    assert features.shape == (count, 6)
    np.testing.assert_allclose(features.mean(axis=0), 0.0, atol=1e-9)
    assert rms_distance(features) == pytest.approx(1.0, rel=1e-9)
    np.testing.assert_array_equal(features, part_features(points, 6))


def test_features_do_not_see_rigid_motion_and_scale():
    points = np.random.default_rng(2).uniform(size=(120, 3)) * [1.0, 0.4, 0.3]
    turn, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))
    moved = 2.5 * points @ turn.T + [1.0, -2.0, 0.5]
    np.testing.assert_allclose(part_features(moved, 4), part_features(points, 4), atol=1e-7)


def test_sparse_and_dense_eigenproblems_agree(monkeypatch):
    points = np.random.default_rng(4).uniform(size=(300, 3)) * [1.0, 0.4, 0.3]
    dense = part_features(points, 4)
    monkeypatch.setattr("physworld.geometry.features.DENSE_LIMIT", 0)
    np.testing.assert_allclose(part_features(points, 4), dense, atol=1e-6)


def test_two_blocks_joined_by_a_neck_are_two_parts():
    left = box((0, 0, 0), (0.4, 0.4, 0.4), (5, 5, 5))
    right = box((0.8, 0, 0), (1.2, 0.4, 0.4), (5, 5, 5))
    neck = box((0.5, 0.2, 0.2), (0.7, 0.2, 0.2), (3, 1, 1))
    features = part_features(np.concatenate([left, right, neck]), 1)[:, 0]
    one, other = features[:125], features[125:250]
    assert np.sign(one.mean()) != np.sign(other.mean())
    assert max(one.std(), other.std()) < 0.15 * abs(one.mean() - other.mean())


def test_disconnected_parts_are_told_apart_and_stay_finite():
    left = box((0, 0, 0), (0.4, 0.4, 0.4), (4, 4, 4))
    shifts = np.array([[0.0, 0, 0], [5.0, 0, 0], [0, 9.0, 0]])
    points = (left + shifts[:, None]).reshape(-1, 3)
    parts, _ = csgraph.connected_components(neighbor_graph(points, 6), directed=False)
    assert parts == 1
    features = part_features(points, 4)
    assert np.isfinite(features).all()
    centres = features.reshape(3, 64, 4).mean(axis=1)
    spread = np.linalg.norm(features.reshape(3, 64, 4) - centres[:, None], axis=-1).max()
    gaps = [np.linalg.norm(centres[i] - centres[j]) for i, j in [(0, 1), (0, 2), (1, 2)]]
    assert min(gaps) > spread


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_few_particles_get_zero_padded_features(count):
    points = np.random.default_rng(count).uniform(size=(count, 3))
    features = part_features(points, 8)
    assert features.shape == (count, 8)
    assert np.isfinite(features).all()
    assert not features[:, max(count - 1, 0) :].any()


def test_coincident_points_stay_finite():
    points = np.repeat(np.random.default_rng(0).uniform(size=(4, 3)), 5, axis=0)
    assert np.isfinite(part_features(points, 3, neighbors=3)).all()


def test_supplied_features_are_carried_by_nearest_neighbour():
    sources = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    targets = np.array([[0.1, 0, 0], [0.9, 0, 0]])
    carried = carry_features(sources, np.array([[1.0, 0.0], [0.0, 3.0]]), targets)
    np.testing.assert_allclose(carried[0] - carried[1], np.array([1.0, -3.0]) / np.sqrt(5.0), atol=1e-12)
    with pytest.raises(ValueError, match="do not belong to 2 points"):
        carry_features(sources, np.zeros((3, 2)), sources)
    with pytest.raises(ValueError, match="1 part features are not finite"):
        carry_features(sources, np.array([[np.nan], [0.0]]), sources)


def test_constant_features_standardise_to_zero():
    assert not standardise(np.full((5, 2), 3.0)).any()
