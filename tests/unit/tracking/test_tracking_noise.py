"""The noise of tracked points: found where it is known, along the rays and across them, and used by a calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import made_scene

from physworld.camera import Camera
from physworld.scene import Scene, sigma_of
from physworld.tracking.noise import sighting_covariances
from physworld.tracking.view import View
from physworld_scenes.bundle import bundle_from_bytes, canonical_archive

FRAMES, POINTS = 60, 40
ALONG, ACROSS = 2e-3, 5e-4  # k in 1/m and p: deviations at a metre


def _view(turn: np.ndarray, shift: np.ndarray) -> View:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, shift
    camera = Camera(width=640, height=480, fx=600.0, fy=600.0, cx=320.0, cy=240.0, world_to_camera=pose)
    return View(camera, lambda frame: np.zeros(0), lambda frame: np.zeros(0), FRAMES)


def _sightings(rng: np.random.Generator, view: View, moves: float) -> tuple[np.ndarray, np.ndarray]:
    """Noisy points (T, N, 3) in the world, and the true covariances (N, 3, 3)."""
    local = rng.uniform([-0.4, -0.3, 0.6], [0.4, 0.3, 2.0], (POINTS, 3))
    far = np.linalg.norm(local, axis=1)
    rays = local / far[:, None]
    along, across = ALONG * far**2, ACROSS * far
    spread = np.einsum("ni,nj->nij", rays, rays)
    known = along[:, None, None] ** 2 * spread + across[:, None, None] ** 2 * (np.eye(3) - spread)
    noise = np.einsum("nij,tnj->tni", np.linalg.cholesky(known), rng.normal(size=(FRAMES, POINTS, 3)))
    sway = moves * np.sin(np.linspace(0.0, 6.0, FRAMES))[:, None, None] * np.array([1.0, 0.5, 0.3])
    pose = view.camera.world_to_camera
    turn, shift = pose[:3, :3], pose[:3, 3]
    return (local + noise + sway - shift) @ turn, turn.T @ known @ turn


@pytest.mark.parametrize("moves", [0.0, 0.05])
def test_noise_along_and_across_the_rays_is_found(moves: float) -> None:
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    views = [_view(np.eye(3), np.array([0.1, 0.0, 0.2])), _view(turn, np.array([0.0, 0.3, 0.1]))]
    parts = [_sightings(rng, view, moves) for view in views]
    points = np.concatenate([part[0] for part in parts], axis=1)
    known = np.concatenate([part[1] for part in parts])
    seen = rng.uniform(size=points.shape[:2]) < 0.9
    found = sighting_covariances(points, seen, np.repeat([0, 1], POINTS), views)
    assert found is not None
    for quadratic in (np.linalg.solve(known, found), np.linalg.solve(found, known)):
        assert np.trace(quadratic, axis1=1, axis2=2) == pytest.approx(3.0, rel=0.25)


def test_errors_that_change_slowly_count_where_nothing_moves() -> None:
    rng = np.random.default_rng(4)
    view = _view(np.eye(3), np.zeros(3))
    points, _ = _sightings(rng, view, 0.0)
    white = sighting_covariances(points, np.ones(points.shape[:2], bool), np.zeros(POINTS, int), [view])
    phases = rng.uniform(0.0, 2.0 * np.pi, (1, POINTS, 3))
    sway = 1.5e-3 * np.sin(np.linspace(0.0, 12.0, FRAMES)[:, None, None] + phases)
    slow = sighting_covariances(points + sway, np.ones(points.shape[:2], bool), np.zeros(POINTS, int), [view])
    assert white is not None and slow is not None
    across = [
        np.linalg.eigvalsh(known)[:, 0] for known in (white, slow)
    ]  # there it is no less than the noise
    assert np.all(across[1] > 1.3 * across[0])


def test_too_little_to_tell_is_said() -> None:
    view = _view(np.eye(3), np.zeros(3))
    still = np.tile([[0.1, 0.0, 1.0]], (8, 2, 1))
    seen = np.zeros((8, 2), dtype=bool)
    assert sighting_covariances(still, seen, np.zeros(2, int), [view]) is None
    assert sighting_covariances(still, ~seen, np.zeros(2, int), [view]) is None  # no noise at all


def _scene() -> Scene:
    rng = np.random.default_rng(2)
    scene = made_scene(rng.uniform(0.0, 0.2, (POINTS, 3)), "blob", frames=6)
    known = np.tile(np.diag([1.0, 1.0, 9.0]) * 1e-6, (POINTS, 1, 1))
    return replace(scene, noise_covariance_m2=known, noise_sigma_m=sigma_of(known))


def test_a_scene_keeps_its_covariances_and_tells_their_deviation() -> None:
    scene = _scene()
    back, _ = bundle_from_bytes(canonical_archive(replace(scene, noise_sigma_m=None)))
    np.testing.assert_allclose(back.noise_covariance_m2, scene.noise_covariance_m2, rtol=1e-6)
    assert back.noise_sigma_m == pytest.approx(scene.noise_sigma_m, rel=1e-6)
    shown = back.weighed(np.tile([1e-3, 1e-3, 3e-3], (POINTS, 1)))
    assert shown == pytest.approx(np.full((POINTS, 3), scene.noise_sigma_m), rel=1e-6)
