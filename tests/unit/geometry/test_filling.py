"""Inside and outside of bodies whose volume is known."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.geometry.filling import inside_surface_points, inside_volume_points, median_spacing

STEP = 0.1


def grid(low: list[float], high: list[float], step: float = STEP) -> np.ndarray:
    axes = [np.arange(a, b + 0.5 * step, step) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def sphere(count: int, radius: float = 1.0) -> np.ndarray:
    """Points spread evenly over a sphere (a golden spiral)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z**2)
    return radius * np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def test_the_spacing_of_a_grid_is_its_step() -> None:
    assert median_spacing(grid([0, 0, 0], [1, 1, 1])) == pytest.approx(STEP)


def test_points_that_fill_an_l_leave_its_notch_empty() -> None:
    cloud = np.concatenate([grid([0, 0, 0], [2, 1, 1]), grid([0, 0, 1.1], [1, 1, 2])])
    rng = np.random.default_rng(0)
    cloud = cloud + rng.normal(scale=0.005, size=cloud.shape)
    query = rng.uniform([0, 0, 0], [2, 1, 2], size=(3000, 3))
    truly = (query[:, 0] < 1) | (query[:, 2] < 1)
    found = inside_volume_points(cloud, query)
    deep_in_notch = (query[:, 0] > 1 + 3 * STEP) & (query[:, 2] > 1 + 3 * STEP)
    assert found[truly].mean() > 0.99
    assert not found[deep_in_notch].any()


def test_the_skin_of_filling_points_is_half_a_spacing_thick() -> None:
    cloud = grid([0, 0, 0], [1, 1, 1])
    above = np.array([[0.5, 0.5, 1 + 0.4 * STEP], [0.5, 0.5, 1 + 0.6 * STEP], [0.5, 0.5, 3.0]])
    assert inside_volume_points(cloud, above).tolist() == [True, False, False]


def test_a_closed_surface_is_filled_and_what_lies_beyond_is_not() -> None:
    query = np.random.default_rng(1).uniform(-1.5, 1.5, size=(3000, 3))
    radius = np.linalg.norm(query, axis=1)
    found = inside_surface_points(sphere(1500), query, cell=0.15)
    assert found[radius < 0.8].all()
    assert not found[radius > 1.3].any()


def test_an_open_surface_stays_a_shell() -> None:
    half = sphere(3000)
    half = half[half[:, 2] > 0]
    query = np.array([[0.0, 0.0, 0.4], [0.0, 0.0, 1.0], [0.0, 0.0, 5.0], [-5.0, 0.0, 0.4]])
    assert inside_surface_points(half, query, cell=0.1).tolist() == [False, True, False, False]


def test_a_cell_finer_than_the_points_is_widened_until_it_closes_the_surface() -> None:
    centre = np.zeros((1, 3))
    assert inside_surface_points(sphere(400), centre, cell=1e-3).all()
