"""Nodes of ropes and sheets from few noisy markers: places, lengths between them, velocities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import made_scene

from physworld.engine.lattice.lattice import box_lattice
from physworld.errors import SceneUnsupported
from physworld.geometry.curves import fit_nodes

FPS = 200.0
RADIUS = 0.5
SLACK_OF_NOISE_M = 0.015  # sqrt(3/8 * 0.2 m * 3 mm), the sag of 0.2 m of rope whose ends come 3 mm closer
ARC = np.linspace(0.0, 1.0, 6)
ROD = box_lattice(np.zeros(1), np.ones(1), (32,))
LENGTH = np.linspace(0.0, 1.0, 401)[:, None]


def arch(arc: np.ndarray) -> np.ndarray:
    """A piece of a circle by arc length, (M, 3)."""
    return RADIUS * np.stack([np.sin(arc / RADIUS), np.zeros_like(arc), 1 - np.cos(arc / RADIUS)], axis=1)


def length(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def test_the_curve_between_markers_has_the_material_s_length_and_place() -> None:
    nodes, velocity = fit_nodes(made_scene(arch(ARC), "rope"), ROD, ARC[:, None])
    curve = ROD.interpolation(LENGTH) @ nodes
    assert length(curve) == pytest.approx(1.0, rel=2e-3)
    np.testing.assert_allclose(curve, arch(LENGTH[:, 0]), atol=6e-3)
    np.testing.assert_allclose(velocity, 0.0, atol=1e-9)


def test_slack_that_the_markers_do_not_show_is_kept_as_length() -> None:
    ends = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.3], [0.4, 0.0, -0.1]])
    nodes, _ = fit_nodes(made_scene(ends, "rope"), ROD, np.array([[0.0], [0.45], [1.0]]))
    assert length(ROD.interpolation(LENGTH) @ nodes) == pytest.approx(1.0, rel=0.03)


def test_velocities_are_those_of_a_falling_and_turning_rope() -> None:
    times = np.arange(12) / FPS
    drift, turn = np.array([0.4, -0.2, 0.1]), 3.0
    c, s = np.cos(turn * times), np.sin(turn * times)
    x, y, z = arch(ARC).T
    track = np.stack(
        [np.outer(c, x) - np.outer(s, y), np.outer(s, x) + np.outer(c, y), np.tile(z, (12, 1))], -1
    )
    track += times[:, None, None] * drift - 0.5 * 9.81 * times[:, None, None] ** 2 * np.array([0.0, 0.0, 1.0])
    scene = replace(made_scene(arch(ARC), "rope", frames=12, times=times), points=track)
    _, velocity = fit_nodes(scene, ROD, ARC[:, None])
    wanted = drift + turn * np.stack([-y, x, np.zeros(6)], axis=1)
    np.testing.assert_allclose(ROD.interpolation(ARC[:, None]) @ velocity, wanted, atol=0.02)


def test_two_frames_show_no_velocity() -> None:
    _, velocity = fit_nodes(made_scene(arch(ARC), "rope", frames=2, train=(0, 2)), ROD, ARC[:, None])
    np.testing.assert_array_equal(velocity, 0.0)


def test_a_hidden_marker_is_bridged() -> None:
    scene = made_scene(arch(ARC), "rope")
    scene.visible[0, 3] = False
    scene.points[0, 3] = 0.0
    nodes, _ = fit_nodes(scene, ROD, ARC[:, None])
    np.testing.assert_allclose(ROD.interpolation(ARC[:, None]) @ nodes, arch(ARC), atol=0.02)


def test_noise_bends_a_straight_rope_only_by_the_length_that_it_takes_from_between_markers() -> None:
    straight = np.stack([ARC, np.zeros(6), np.zeros(6)], axis=1)
    noisy = straight + np.random.default_rng(4).normal(scale=1e-3, size=straight.shape)
    nodes, _ = fit_nodes(made_scene(noisy, "rope"), ROD, ARC[:, None])
    curve = ROD.interpolation(LENGTH) @ nodes
    np.testing.assert_allclose(
        curve, np.stack([LENGTH[:, 0], *[0 * LENGTH[:, 0]] * 2], 1), atol=SLACK_OF_NOISE_M
    )


def test_a_rolled_sheet_keeps_its_width_and_its_length() -> None:
    sheet = box_lattice(np.zeros(2), np.array([1.0, 0.5]), (10, 5))
    material = np.stack(np.meshgrid(ARC, [0.0, 0.25, 0.5], indexing="ij"), axis=-1).reshape(-1, 2)
    rolled = arch(material[:, 0]) + material[:, 1:] * np.array([0.0, 1.0, 0.0])
    nodes, _ = fit_nodes(made_scene(rolled, "sheet"), sheet, material)
    np.testing.assert_allclose(sheet.interpolation(material) @ nodes, rolled, atol=4e-3)
    along = np.concatenate([LENGTH, np.full_like(LENGTH, 0.25)], axis=1)
    assert length(sheet.interpolation(along) @ nodes) == pytest.approx(1.0, rel=5e-3)


def test_one_visible_marker_places_no_rope() -> None:
    scene = made_scene(arch(ARC), "rope")
    scene.visible[0, 1:] = False
    with pytest.raises(SceneUnsupported, match="1 of 6 points are visible in the first frame"):
        fit_nodes(scene, ROD, ARC[:, None])
