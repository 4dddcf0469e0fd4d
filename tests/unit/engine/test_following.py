"""Tracked points among particles: exact under affine motion, followed under flow."""

from __future__ import annotations

import numpy as np
import pytest

from physworld.engine.lattice.following import follow


def cloud(seed: int = 0, count: int = 400) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.1, 0.1, size=(count, 3))


def test_points_inside_and_beside_a_body_follow_an_affine_motion_exactly() -> None:
    particles = cloud()
    points = np.array([[0.0, 0.01, 0.02], [0.05, -0.03, 0.0], [0.0, 0.0, 0.13]])
    steps = np.linspace(0, 1, 9)
    maps = np.array(
        [np.eye(3) + t * np.array([[0.2, -0.9, 0], [0.8, 0.1, 0.3], [0, 0.1, -0.2]]) for t in steps]
    )
    shifts = np.outer(steps, [0.3, 0.0, -0.5])
    paths = follow(points, np.einsum("tij,pj->tpi", maps, particles) + shifts[:, None])
    expected = np.einsum("tij,nj->tni", maps, points) + shifts[:, None]
    assert np.abs(paths - expected).max() < 1e-12


def test_a_marker_beside_a_flat_layer_keeps_its_distance_when_the_layer_turns() -> None:
    grid = (
        np.stack(np.meshgrid(np.arange(10), np.arange(10), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
        * 0.01
    )
    marker = np.array([[0.045, 0.045, 0.02]])
    angle = np.linspace(0, 1.5, 7)
    turn = np.zeros((7, 3, 3))
    turn[:, 0, 0], turn[:, 0, 2], turn[:, 1, 1] = np.cos(angle), np.sin(angle), 1.0
    turn[:, 2, 0], turn[:, 2, 2] = -np.sin(angle), np.cos(angle)
    paths = follow(marker, np.einsum("tij,pj->tpi", turn, grid))
    assert np.abs(paths[:, 0] - np.einsum("tij,j->ti", turn, marker[0])).max() < 1e-12


def test_a_point_in_sheared_material_stays_with_the_flow() -> None:
    """Layers slide past one another without end; no affine map from the start describes them, each step does."""
    particles = cloud(1, 3000)
    times = np.linspace(0, 6, 121)
    speed = np.tanh(particles[:, 2] / 0.03)
    flow = particles[None] + times[:, None, None] * speed[None, :, None] * np.array([0.05, 0, 0])
    point = np.array([[0.0, 0.0, 0.02]])
    paths = follow(point, flow)
    expected = times[-1] * np.tanh(0.02 / 0.03) * 0.05
    assert paths[-1, 0, 0] == pytest.approx(expected, rel=0.15)
    assert abs(paths[-1, 0, 2] - 0.02) < 0.01


def test_a_point_goes_with_its_half_of_a_body_that_parts() -> None:
    particles = cloud(2, 2000)
    side = np.sign(particles[:, 0])
    flow = particles[None] + np.linspace(0, 0.5, 26)[:, None, None] * side[None, :, None] * np.array(
        [1.0, 0, 0]
    )
    paths = follow(np.array([[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]]), flow)
    assert paths[-1, 0] == pytest.approx([0.53, 0.0, 0.0], abs=0.01)
    assert paths[-1, 1] == pytest.approx([-0.53, 0.0, 0.0], abs=0.01)


def test_too_few_particles_are_refused() -> None:
    with pytest.raises(ValueError, match="got 3"):
        follow(np.zeros((1, 3)), np.zeros((2, 3, 3)))
