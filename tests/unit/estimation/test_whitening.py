"""Whitening against the dense covariance that it factors, and what it does to a misplaced point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import made_scene

from physworld.estimation.noise import freeze
from physworld.estimation.whitening import whitener
from physworld.scene import sigma_of

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


@pytest.mark.parametrize("beside", [1.0, 40.0])
def test_whitened_products_are_those_of_the_inverse_covariance(parts: tuple, beside: float) -> None:
    """Of noise and places, also beside an error of the model of which a place is no larger part than it is."""
    scene, split, responses, tracks = parts
    white = whitener(scene, split, SIGMA, responses).beside(beside)
    seen = scene.visible[slice(*split.train)]
    frames, points = np.nonzero(seen)
    place = np.zeros((3 * len(frames), 3 * POINTS))
    for row, (frame, point) in enumerate(zip(frames, points, strict=True)):
        place[3 * row : 3 * row + 3, 3 * point : 3 * point + 3] = responses[frame + split.train[0], point]
    covariance = SIGMA**2 * (np.eye(len(place)) + place @ place.T / beside)
    error = (scene.points - tracks)[slice(*split.train)][seen].reshape(-1)
    change = tracks[slice(*split.train)][seen].reshape(-1)
    got = white.residual(tracks)
    assert got @ got == pytest.approx(error @ np.linalg.solve(covariance, error), rel=1e-9)
    expected = change @ np.linalg.solve(covariance, error)
    assert white.change(tracks) @ got == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("beside", [1.0, 40.0])
def test_what_all_points_share_joins_the_covariance(parts: tuple, beside: float) -> None:
    scene, split, _, tracks = parts
    rng = np.random.default_rng(2)
    shared = [rng.normal(scale=SIGMA, size=tracks.shape) for _ in range(2)]
    white = whitener(scene, split, SIGMA, np.zeros((FRAMES, POINTS, 3, 3)))
    assert white.knowing([]) is white
    seen = scene.visible[slice(*split.train)]
    common = np.stack([change[slice(*split.train)][seen].reshape(-1) for change in shared], axis=1)
    covariance = SIGMA**2 * np.eye(len(common)) + common @ common.T / beside
    error = (scene.points - tracks)[slice(*split.train)][seen].reshape(-1)
    got = white.knowing(shared, beside).residual(tracks)
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


def test_covariances_of_points_are_those_of_generalised_least_squares(parts: tuple) -> None:
    scene, split, responses, tracks = parts
    rng = np.random.default_rng(5)
    roots = rng.normal(size=(POINTS, 3, 3)) * 1e-3 + 2e-3 * np.eye(3)
    known = roots @ roots.transpose(0, 2, 1)
    scene = replace(scene, noise_covariance_m2=known, noise_sigma_m=sigma_of(known))
    responses[0] = np.eye(3)  # places are told along the world's axes
    white = whitener(scene, split, scene.noise_sigma_m, responses)
    seen = scene.visible[slice(*split.train)]
    frames, points = np.nonzero(seen)
    covariance = np.zeros((3 * len(frames), 3 * len(frames)))
    for row, point in enumerate(
        points
    ):  # a sighting's own noise, and that of frame 0, which places the point
        here = slice(3 * row, 3 * row + 3)
        covariance[here, here] += known[point]
        for other in np.flatnonzero(points == point):
            there = slice(3 * other, 3 * other + 3)
            near, far = (responses[frames[k] + split.train[0], point] for k in (row, other))
            covariance[here, there] += near @ known[point] @ far.T
    error = (scene.points - tracks)[slice(*split.train)][seen].reshape(-1)
    got = white.residual(tracks)
    assert got @ got == pytest.approx(error @ np.linalg.solve(covariance, error), rel=1e-8)


def test_places_are_found_where_the_noise_has_directions(parts: tuple) -> None:
    scene, split, _, _ = parts
    eye = np.broadcast_to(np.eye(3), (FRAMES, POINTS, 3, 3)).copy()
    known = np.tile(np.diag([1.0, 4.0, 25.0]) * 1e-6, (POINTS, 1, 1))
    scene = replace(scene, noise_covariance_m2=known, noise_sigma_m=sigma_of(known))
    white = whitener(scene, split, scene.noise_sigma_m, eye)
    sightings = scene.visible[slice(*split.train)].sum(axis=0)
    shift = np.array([[0.5e-3, -1e-3, 4e-3], [0.0, 2e-3, -6e-3], [0.0, 0.0, 0.0]])
    found = white.place_errors(scene.points - shift)
    assert found == pytest.approx(shift * (sightings / (1 + sightings))[:, None], rel=1e-9, abs=1e-12)


def test_equal_noise_along_every_axis_changes_nothing(parts: tuple) -> None:
    scene, split, responses, tracks = parts
    responses[0] = np.eye(3)
    alike = replace(scene, noise_covariance_m2=np.tile(SIGMA**2 * np.eye(3), (POINTS, 1, 1)))
    plain, white = (whitener(one, split, SIGMA, responses).residual(tracks) for one in (scene, alike))
    np.testing.assert_allclose(white, plain, rtol=1e-9)
    assert alike.with_noise(2 * SIGMA).noise_sigma_m == 2 * SIGMA
    scaled = alike.with_noise(2 * SIGMA).noise_covariance_m2
    assert scaled is not None and sigma_of(scaled) == pytest.approx(2 * SIGMA)
