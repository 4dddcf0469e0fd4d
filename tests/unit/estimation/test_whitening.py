"""Whitening against the dense covariance that it factors, and what it does to a misplaced point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import made_scene

from physworld.estimation.noise import freeze
from physworld.estimation.whitening import whitener

SIGMA, FRAMES, POINTS = 2e-3, 9, 3


@pytest.fixture
def parts() -> tuple:
    """A scene with occlusions, random responses and a prediction."""
    rng = np.random.default_rng(1)
    scene = made_scene(rng.normal(size=(POINTS, 3)), "blob", frames=FRAMES)
    visible = rng.uniform(size=(FRAMES, POINTS)) < 0.7
    visible[0] = True
    scene = replace(scene, visible=visible, points=scene.points + rng.normal(size=scene.points.shape))
    responses = rng.normal(size=(FRAMES, POINTS, 3, 3))
    return scene, freeze(scene, 4, 1), responses, rng.normal(size=scene.points.shape)


def test_whitened_products_are_those_of_the_inverse_covariance(parts: tuple) -> None:
    scene, split, responses, tracks = parts
    white = whitener(scene, split, SIGMA, responses)
    seen = scene.visible[slice(*split.train)]
    frames, points = np.nonzero(seen)
    place = np.zeros((3 * len(frames), 3 * POINTS))
    for row, (frame, point) in enumerate(zip(frames, points, strict=True)):
        place[3 * row : 3 * row + 3, 3 * point : 3 * point + 3] = responses[frame + split.train[0], point]
    covariance = SIGMA**2 * (np.eye(len(place)) + place @ place.T)
    error = (scene.points - tracks)[slice(*split.train)][seen].reshape(-1)
    change = tracks[slice(*split.train)][seen].reshape(-1)
    got = white.residual(tracks)
    assert got @ got == pytest.approx(error @ np.linalg.solve(covariance, error), rel=1e-9)
    expected = change @ np.linalg.solve(covariance, error)
    assert white.change(tracks) @ got == pytest.approx(expected, rel=1e-9)


def test_what_all_points_share_joins_the_covariance(parts: tuple) -> None:
    scene, split, _, tracks = parts
    rng = np.random.default_rng(2)
    shared = [rng.normal(scale=SIGMA, size=tracks.shape) for _ in range(2)]
    white = whitener(scene, split, SIGMA, np.zeros((FRAMES, POINTS, 3, 3)))
    assert white.knowing([]) is white
    seen = scene.visible[slice(*split.train)]
    common = np.stack([change[slice(*split.train)][seen].reshape(-1) for change in shared], axis=1)
    covariance = SIGMA**2 * np.eye(len(common)) + common @ common.T
    error = (scene.points - tracks)[slice(*split.train)][seen].reshape(-1)
    got = white.knowing(shared).residual(tracks)
    assert got @ got == pytest.approx(error @ np.linalg.solve(covariance, error), rel=1e-9)


def test_the_place_of_a_point_is_found_and_clipped(parts: tuple) -> None:
    scene, split, _, _ = parts
    eye = np.broadcast_to(np.eye(3), (FRAMES, POINTS, 3, 3))
    white = whitener(scene, split, SIGMA, eye)
    sightings = scene.visible[slice(*split.train)].sum(axis=0)
    shift = np.array([[0.5, -1.0, 0.2], [0.0, 9.0, 0.0], [0.0, 0.0, 0.0]]) * SIGMA
    found = white.place_errors(scene.points - shift)
    expected = shift * (sightings / (1 + sightings))[:, None]
    assert found == pytest.approx(np.clip(expected, -3 * SIGMA, 3 * SIGMA), rel=1e-9, abs=1e-12)


def test_a_point_without_a_place_is_left_out_unless_none_has_one(parts: tuple) -> None:
    scene, split, responses, _ = parts
    scene.visible[:] = True
    scene.visible[0, 1] = False
    assert set(whitener(scene, split, SIGMA, responses).points) == {0, 2}
    scene.visible[0] = False
    assert set(whitener(scene, split, SIGMA, responses).points) == {0, 1, 2}


def test_columns_go_from_one_whitener_to_another(parts: tuple) -> None:
    scene, split, responses, _ = parts
    rng = np.random.default_rng(7)
    own = whitener(scene, split, 0.01, responses).knowing([rng.normal(size=scene.points.shape) * 0.02])
    other = whitener(scene, split, 0.01, responses + rng.normal(scale=0.3, size=responses.shape))
    changes = [rng.normal(size=scene.points.shape) for _ in range(3)]
    columns, wanted = (np.stack([w.change(c) for c in changes], axis=1) for w in (own, other))
    np.testing.assert_allclose(other.over_from(own, columns), wanted, rtol=1e-9, atol=1e-9)
    assert other.over_from(own, columns[:, :0]).shape == (len(columns), 0)
