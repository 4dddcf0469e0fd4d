"""Inside and outside of bodies whose volume is known."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.geometry.filling import (
    filled_body,
    inside_surface_points,
    median_spacing,
)

pytestmark = pytest.mark.slow

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
    found = filled_body(cloud).contains(query)
    deep_in_notch = (query[:, 0] > 1 + 3 * STEP) & (query[:, 2] > 1 + 3 * STEP)
    assert found[truly].mean() > 0.99
    assert not found[deep_in_notch].any()


def test_the_skin_of_filling_points_is_half_a_spacing_thick() -> None:
    cloud = grid([0, 0, 0], [1, 1, 1])
    above = np.array([[0.5, 0.5, 1 + 0.4 * STEP], [0.5, 0.5, 1 + 0.6 * STEP], [0.5, 0.5, 3.0]])
    assert filled_body(cloud).contains(above).tolist() == [True, False, False]


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


VOLUME_BIAS = 0.03
"""Of the mean over several draws; single clouds scatter by 1 % (4000 points) to 4 % (500)."""

STREWN = {
    "sphere": (
        lambda p: np.linalg.norm(p, axis=1) < 1,
        ([-1, -1, -1], [1, 1, 1]),
        4 / 3 * np.pi,
    ),
    "box": (lambda p: np.ones(len(p), dtype=bool), ([0, 0, 0], [2, 1, 0.6]), 1.2),
    "torus": (
        lambda p: (np.hypot(p[:, 0], p[:, 1]) - 1) ** 2 + p[:, 2] ** 2 < 0.16,
        ([-1.4, -1.4, -0.4], [1.4, 1.4, 0.4]),
        2 * np.pi**2 * 0.16,
    ),
}


@pytest.mark.parametrize(("count", "draws"), [(600, 8), (2500, 3)])
@pytest.mark.parametrize("name", STREWN)
def test_randomly_strewn_points_stand_for_their_whole_volume(name: str, count: int, draws: int) -> None:
    holds, (low, high), volume = STREWN[name]
    found = []
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        cloud = rng.uniform(low, high, size=(6 * count, 3))
        body = filled_body(cloud[holds(cloud)][:count])
        found.append(body.volume_m3 / volume)
    assert np.mean(found) == pytest.approx(1.0, abs=VOLUME_BIAS)
    probe = rng.uniform(np.subtract(low, 0.2), np.add(high, 0.2), size=(20000, 3))
    counted = body.contains(probe).mean() * np.prod(np.subtract(high, low) + 0.4)
    assert counted == pytest.approx(body.volume_m3, rel=0.03)


def test_a_few_points_grow_by_the_usual_amount() -> None:
    cloud = np.random.default_rng(0).uniform(0, 1, size=(40, 3))
    body = filled_body(cloud)
    assert body.growth == pytest.approx(
        0.31
    )  # of the distance between points, as on strewn balls, boxes and tori
    assert np.prod(np.ptp(cloud, axis=0)) * 0.6 < body.volume_m3 < 1.3


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("count", [300, 2000])
def test_points_on_a_closed_surface_bound_its_volume(count: int, even: bool) -> None:
    strewn = np.random.default_rng(2).normal(size=(count, 3))
    surface = sphere(count) if even else strewn / np.linalg.norm(strewn, axis=1, keepdims=True)
    probe = np.random.default_rng(5).uniform(-1.4, 1.4, size=(20000, 3))
    volume = inside_surface_points(surface, probe, cell=0.1).mean() * 2.8**3
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.05)


def test_points_that_lie_closer_at_the_ends_make_the_ends_no_thicker() -> None:
    """A spindle whose points are spread evenly over its length though its section is a tenth at the ends."""
    ends = []
    for seed in range(3):
        unit = np.random.default_rng(seed).uniform(-1.0, 1.0, size=(2500, 3))
        cloud = np.hstack([2.0 * unit[:, :1], unit[:, 1:] * np.sqrt(1.0 - 0.9 * unit[:, :1] ** 2)])
        query = np.random.default_rng(9).uniform([-2.0, -1.0, -1.0], [2.0, 1.0, 1.0], size=(100_000, 3))
        held = filled_body(cloud).contains(query)
        along = np.abs(query[:, 0]) / 2.0
        ends.append(held[along > 0.8].mean() / (1.0 - 0.9 * along[along > 0.8] ** 2).mean())
    assert np.mean(ends) == pytest.approx(1.0, abs=0.04)
