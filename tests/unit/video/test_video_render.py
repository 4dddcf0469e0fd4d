"""The renderer against a plain numpy one, closed forms and what turning everything must not change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import sph_harm_y

from physworld.video import Camera, Gaussians, Renderer, gaussians_at_points, look_at, orbit_view
from physworld.video.blending import blended
from physworld.video.gaussians import SH_DC
from physworld.video.render import _basis, rotation_matrices
from physworld.worldmodel.model.skinning import quaternion_of, quaternion_product

ROUNDING = 1e-4
"""Of two kernels: one may finish a pixel, of which 1e-4 is left, a Gaussian earlier. A step of 8 bits is 4e-3."""


def some(count: int, harmonics: int = 16, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(count, 4))
    return Gaussians(
        rng.uniform(-0.3, 0.3, (count, 3)),
        rng.uniform(np.log(0.01), np.log(0.08), (count, 3)),
        turns / np.linalg.norm(turns, axis=1, keepdims=True),
        rng.normal(0.0, 2.0, count),
        rng.normal(0.0, 0.4, (count, harmonics, 3)),
    )


def plain(gaussians: Gaussians, camera: Camera, colours: np.ndarray, background: float) -> np.ndarray:
    """Every Gaussian at every pixel, in the order of depth: no tiles, no reach."""
    pose = camera.world_to_camera
    local = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    left, picture = np.ones(x.shape), np.zeros((*x.shape, 3))
    done = np.zeros(x.shape, dtype=bool)
    axes = rotation_matrices(gaussians.rotations) * np.exp(gaussians.log_scales)[:, None]
    for g in np.argsort(local[:, 2]):
        px, py, pz = local[g]
        jacobian = np.array(
            [[camera.fx / pz, 0, -camera.fx * px / pz**2], [0, camera.fy / pz, -camera.fy * py / pz**2]]
        )
        spread = jacobian @ pose[:3, :3] @ axes[g]
        inverse = np.linalg.inv(spread @ spread.T + 0.3 * np.eye(2))
        offset = np.stack([x - camera.fx * px / pz - camera.cx, y - camera.fy * py / pz - camera.cy], axis=-1)
        square = np.einsum("...i,ij,...j->...", offset, inverse, offset)
        alpha = np.minimum(0.99, gaussians.opacities[g] * np.exp(-0.5 * square))
        alpha = np.where((alpha >= 1 / 255) & ~done, alpha, 0.0)
        done |= left * (1 - alpha) < 1e-4
        alpha = np.where(done, 0.0, alpha)
        picture += (left * alpha)[..., None] * colours[g]
        left *= 1 - alpha
    return np.clip(picture + left[..., None] * background, 0.0, 1.0)


def test_the_renderer_agrees_with_a_plain_one() -> None:
    camera = look_at(np.array([1.5, -1.0, 0.7]), np.zeros(3), 61, 45)
    gaussians = some(40)
    renderer = Renderer(camera, (0.25, 0.25, 0.25))
    expected = plain(gaussians, camera, renderer._colours(gaussians, None), 0.25)
    difference = np.abs(renderer.render(gaussians).rgb - expected)
    assert expected.std() > 0.05
    assert difference.max() < 0.02 and difference.mean() < 1e-3  # tiles end at three standard deviations


@pytest.mark.parametrize(("width", "height"), [(61, 45), (320, 240)])
def test_rows_and_pixels_give_one_picture(width: int, height: int) -> None:
    """The kernel of the processor against that of CUDA: thin, wide, faint and opaque Gaussians, cut by the edge."""
    camera = look_at(np.array([0.5, -0.4, 0.3]), np.zeros(3), width, height)
    splat = some(400)
    wide = np.where(
        np.arange(400)[:, None] % 9 == 0, splat.log_scales + np.array([2.0, -3.0, 0.0]), splat.log_scales
    )
    splat = replace(splat, log_scales=wide, opacity_logits=2.5 * splat.opacity_logits)
    canvas, inputs = Renderer(camera, (0.2, 0.7, 0.4)).prepared(splat)
    rows, pixels = (blended(canvas, inputs, by_pixel) for by_pixel in (False, True))
    for ours, theirs in zip(rows, pixels, strict=True):
        assert np.abs(ours.numpy() - theirs.numpy()).max() < ROUNDING
    assert pixels[1].numpy().max() > 0.9998  # coverage at which a pixel is finished


def test_one_gaussian_ahead_has_its_closed_form() -> None:
    camera = Camera(64, 64, 100.0, 100.0, 32.0, 32.0, np.eye(4))
    sigma, distance = 0.05, 2.0
    one = Gaussians(
        np.array([[0.0, 0.0, distance]]),
        np.full((1, 3), np.log(sigma)),
        np.array([[1.0, 0, 0, 0]]),
        np.array([1.0]),
        np.full((1, 1, 3), 0.5 / SH_DC),
    )
    picture = Renderer(camera, (0.0, 0.0, 0.0)).render(one)
    variance = (100.0 * sigma / distance) ** 2 + 0.3
    offset = np.arange(64) + 0.5 - 32.0
    expected = one.opacities[0] * np.exp(-0.5 * (offset[24:40] ** 2 + 0.25) / variance)
    np.testing.assert_allclose(
        picture.alpha[31, 24:40], np.where(expected >= 1 / 255, expected, 0.0), atol=1e-6
    )
    np.testing.assert_allclose(picture.rgb[31, 31], picture.alpha[31, 31], atol=1e-6)  # white on black
    assert picture.depth[31, 31] == pytest.approx(distance) and picture.depth[0, 0] == 0.0


def test_harmonics_are_those_of_the_field() -> None:
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(20, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    polar, azimuth = np.arccos(direction[:, 2]), np.arctan2(direction[:, 1], direction[:, 0])
    expected = []
    for degree in (1, 2, 3):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)  # with the Condon-Shortley phase
            part = value.imag if order < 0 else value.real
            expected.append(part if order == 0 else np.sqrt(2.0) * part)
    np.testing.assert_allclose(_basis(direction), np.stack(expected, axis=1), atol=1e-12)


def test_turning_the_object_and_the_camera_changes_nothing() -> None:
    eye, gaussians = np.array([1.2, 0.4, 0.5]), some(30, seed=4)
    turn = np.array([0.8, 0.1, -0.4, 0.3])
    turn /= np.linalg.norm(turn)
    matrix = rotation_matrices(turn[None])[0]
    camera = look_at(eye, np.zeros(3), 48, 40)
    pose = camera.world_to_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ matrix.T
    turned_camera = Camera(48, 40, camera.fx, camera.fy, camera.cx, camera.cy, pose)
    turned = Gaussians(
        gaussians.means @ matrix.T,
        gaussians.log_scales,
        quaternion_product(np.tile(turn, (30, 1)), gaussians.rotations),
        gaussians.opacity_logits,
        gaussians.harmonics,
    )
    before = Renderer(camera).render(gaussians)
    after = Renderer(turned_camera).render(turned, np.tile(quaternion_of(matrix), (30, 1)))
    np.testing.assert_allclose(after.rgb, before.rgb, atol=2e-4)
    assert (
        np.abs(Renderer(turned_camera).render(turned).rgb - before.rgb).max() > 0.02
    )  # its colours turn too


def test_a_splat_behind_the_camera_is_not_seen() -> None:
    camera = look_at(np.array([0.0, -2.0, 0.0]), np.array([0.0, -3.0, 0.0]), 32, 32)
    assert not Renderer(camera).render(some(10)).alpha.any()


def test_an_orbit_holds_everything_in_view() -> None:
    points = np.random.default_rng(0).uniform([-0.1, 0, 0], [0.4, 0.1, 0.8], (200, 3))
    for azimuth in (0.0, 90.0, 200.0):
        camera = orbit_view(points, azimuth, width=200, height=300)
        pixels, depth = camera.project(points)
        assert (depth > 0).all() and (pixels >= 0).all() and (pixels <= [200, 300]).all()
    picture = Renderer(camera).render(gaussians_at_points(points))
    assert picture.alpha.max() > 0.9 and picture.alpha[0].max() < 0.1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"width": 0}, "0 x 48 px"),
        ({"fx": -1.0}, "must be positive and finite, got -1"),
        ({"world_to_camera": 2 * np.eye(4)}, "rigid transform"),
    ],
)
def test_a_camera_that_is_none_is_refused(change: dict, said: str) -> None:
    good = {
        "width": 64,
        "height": 48,
        "fx": 50.0,
        "fy": 50.0,
        "cx": 32.0,
        "cy": 24.0,
        "world_to_camera": np.eye(4),
    }
    with pytest.raises(ValueError, match=said):
        Camera(**{**good, **change})
    with pytest.raises(ValueError, match="is none"):
        look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]))
