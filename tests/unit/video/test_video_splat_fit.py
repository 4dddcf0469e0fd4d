"""A splat fitted to pictures: its gradient, its renderer, what it finds again, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from test_video_render import some

from physworld.arrays import Array
from physworld.errors import SplatNotFitted
from physworld.video import (
    Camera,
    Gaussians,
    Renderer,
    SplatConfig,
    SplatView,
    fit_splat,
    from_ply,
    look_at,
    to_ply,
)
from physworld.video.blending import Blend, Canvas
from physworld.video.gaussians import SH_DC
from physworld.video.projection import project, tiles
from physworld.video.splat_fit import _target, _tensors, loss_of
from physworld.video.splat_start import smoothed, start_from_depth, start_from_points
from physworld.video.ssim import structural_similarity_of

CAMERA = look_at(np.array([0.2, -0.9, 0.4]), np.zeros(3), 96, 72)
BACKGROUND = (0.3, 0.6, 0.9)


def drawn(free: dict[str, torch.Tensor], camera: Camera) -> tuple[torch.Tensor, ...]:
    turns = free["rotations"] / free["rotations"].norm(dim=1, keepdim=True)
    seen = project(free["means"], free["log_scales"], turns, camera)
    starts, order = tiles(
        seen.centre.detach().numpy(),
        seen.reach,
        seen.depth.detach().numpy(),
        seen.good,
        camera.width,
        camera.height,
    )
    canvas = Canvas(camera.width, camera.height, starts, order, BACKGROUND)
    colour = (0.5 + SH_DC * free["colours"]).clamp(min=0.0)
    found: tuple[torch.Tensor, ...] = Blend.apply(
        seen.centre, seen.conic, torch.sigmoid(free["opacity_logits"]), colour, seen.depth, canvas
    )
    return found


def test_the_pictures_of_the_fit_are_those_of_the_renderer() -> None:
    splat = some(300, harmonics=1)
    rgb, alpha, far = (part.numpy() for part in drawn(_tensors(splat), CAMERA))
    picture = Renderer(CAMERA, BACKGROUND).render(splat)
    np.testing.assert_array_equal(np.clip(rgb, 0, 1), picture.rgb)
    np.testing.assert_array_equal(alpha, picture.alpha)
    np.testing.assert_allclose(far, picture.depth * picture.alpha, atol=1e-5)


def test_the_gradient_of_every_number_is_that_of_finite_differences() -> None:
    # wide Gaussians in one tile: nothing falls below the least alpha, where pictures jump
    camera = look_at(np.array([0.0, -1.0, 0.1]), np.zeros(3), 16, 16)
    rng = np.random.default_rng(3)
    turns = rng.normal(size=(5, 4))
    splat = Gaussians(
        rng.uniform(-0.1, 0.1, (5, 3)),
        np.log(rng.uniform(0.25, 0.45, (5, 3))),
        turns / np.linalg.norm(turns, axis=1, keepdims=True),
        rng.uniform(-1.0, 0.5, 5),
        rng.uniform(-1.0, 1.0, (5, 1, 3)),
    )
    weights = [torch.from_numpy(rng.normal(size=(16, 16, *more))) for more in ((3,), (), ())]

    def total(free: dict[str, torch.Tensor]) -> torch.Tensor:
        return sum((w * part).sum() for w, part in zip(weights, drawn(free, camera), strict=True))  # type: ignore[return-value]

    free = {name: tensor.requires_grad_() for name, tensor in _tensors(splat).items()}
    total(free).backward()  # type: ignore[no-untyped-call]
    step = 2e-3
    for name, tensor in free.items():
        assert tensor.grad is not None
        found, differences = tensor.grad.numpy().ravel(), np.zeros(tensor.numel())
        for number in range(tensor.numel()):
            sides = []
            for sign in (1.0, -1.0):
                moved = {key: value.detach().clone() for key, value in free.items()}
                moved[name].view(-1)[number] += sign * step
                sides.append(float(total(moved)))
            differences[number] = (sides[0] - sides[1]) / (2.0 * step)
        largest = np.abs(differences).max()
        assert largest > 0.05, name
        np.testing.assert_allclose(found, differences, atol=4e-3 * largest, err_msg=name)


def test_the_loss_falls_along_its_gradient_as_the_gradient_says() -> None:
    view, splat = shown(CAMERA)
    target = _target(view, splat, SplatConfig())
    rng = np.random.default_rng(1)
    start = replace(splat, harmonics=splat.harmonics + rng.normal(0, 0.3, splat.harmonics.shape))
    free = {name: tensor.requires_grad_() for name, tensor in _tensors(start).items()}
    loss_of(free, target, BACKGROUND, SplatConfig()).backward()  # type: ignore[no-untyped-call]
    colour = free["colours"].grad
    assert colour is not None
    step = 1e-2 * colour / colour.norm()
    sides = []
    for sign in (1.0, -1.0):
        moved = {name: tensor.detach() for name, tensor in free.items()} | {
            "colours": free["colours"].detach() + sign * step
        }
        sides.append(float(loss_of(moved, target, BACKGROUND, SplatConfig())))
    assert sides[0] - sides[1] == pytest.approx(2e-2 * float(colour.norm()), rel=0.05)


def test_ssim_is_that_of_scikit_image() -> None:
    rng = np.random.default_rng(0)
    one, other = np.zeros((40, 52, 3)), np.zeros((40, 52, 3))  # beyond the edges both are zero here and there
    one[8:-8, 8:-8], other[8:-8, 8:-8] = rng.uniform(size=(2, 24, 36, 3))
    other = 0.5 * (one + other)
    _, every = structural_similarity(
        one, other, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        full=True,
    )  # fmt: skip
    found = structural_similarity_of(torch.from_numpy(one), torch.from_numpy(other))
    assert float(found) == pytest.approx(every.mean(), abs=1e-9) and every.mean() < 0.95
    assert float(structural_similarity_of(torch.from_numpy(one), torch.from_numpy(one))) == pytest.approx(1.0)


def painted(count: int = 6000) -> Gaussians:
    """A dense ball in stripes."""
    rng = np.random.default_rng(5)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    stripes = 0.5 + 0.4 * np.sin(12.0 * normal)
    return Gaussians(
        0.2 * normal,
        np.full((count, 3), np.log(0.012)),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.full(count, 4.0),
        ((stripes - 0.5) / SH_DC)[:, None],
    )


def shown(camera: Camera) -> tuple[SplatView, Gaussians]:
    splat = painted()
    picture = Renderer(camera).render(splat)
    mask = picture.alpha > 0.5
    view = SplatView(
        camera, np.round(picture.rgb * 255).astype(np.uint8), mask, np.where(mask, picture.depth, 0.0)
    )
    return view, splat


def psnr(one: Array, other: Array) -> float:
    return float(-10.0 * np.log10(np.mean((one - other) ** 2)))


def test_a_fitted_splat_shows_the_picture_better_than_its_start_and_lies_on_the_surface() -> None:
    view, _ = shown(CAMERA)
    fitted = fit_splat([view], config=SplatConfig(steps=80))
    read = from_ply(to_ply(fitted.gaussians))
    assert view.depth is not None and len(fitted.losses) == 80
    inside, given = view.inside, view.picture / 255.0
    after = Renderer(CAMERA).render(read)
    before = Renderer(CAMERA).render(start_from_depth([view], SplatConfig().most))
    assert psnr(after.rgb[inside], given[inside]) > psnr(before.rgb[inside], given[inside]) + 5.0
    assert psnr(after.rgb[inside], given[inside]) > 25.0
    assert (after.alpha[~inside] > 0.5).mean() < 0.01 and (after.alpha[inside] > 0.5).mean() > 0.99
    assert np.median(np.abs(after.depth - view.depth)[inside]) < 2e-3
    assert np.abs(np.linalg.norm(read.means, axis=1) - 0.2).mean() < 0.02  # 0.2 m is the ball's radius


def test_a_start_has_no_more_gaussians_than_are_wanted_and_spreads_them_over_the_object() -> None:
    view, _ = shown(CAMERA)
    second = shown(look_at(np.array([0.9, 0.3, 0.3]), np.zeros(3), 96, 72))[0]
    for views in ([view], [view, second]):
        for most in (7, 100, 333):
            start = start_from_depth(views, most)
            assert 0.5 * most < len(start) <= most
            assert (np.ptp(start.means, axis=0) > 0.1).all()  # of a ball of 0.4 m, whose front is seen


def test_two_cameras_are_fitted_together_from_points_without_depth() -> None:
    other = look_at(np.array([0.9, 0.3, 0.3]), np.zeros(3), 96, 72)
    views = [replace(shown(camera)[0], depth=None) for camera in (CAMERA, other)]
    points = painted(3000).means
    fitted = fit_splat(views, points, SplatConfig(steps=80))
    for view in views:
        picture = Renderer(view.camera).render(fitted.gaussians)
        assert psnr(picture.rgb[view.inside], view.picture[view.inside] / 255.0) > 24.0
    again = fit_splat(views, points, SplatConfig(steps=5))
    np.testing.assert_array_equal(again.losses, fit_splat(views, points, SplatConfig(steps=5)).losses)


def test_what_covers_the_object_says_nothing_and_what_lies_behind_it_keeps_it_away() -> None:
    view, splat = shown(CAMERA)
    assert view.depth is not None and view.mask is not None
    bar = np.zeros_like(view.mask)
    bar[:, 40:50] = True
    for depth, counted in ((0.3, False), (5.0, True)):  # before and behind the ball, whose middle is 1 m away
        seen = replace(view, mask=view.mask & ~bar, depth=np.where(bar, depth, view.depth))
        target = _target(seen, splat, SplatConfig())
        columns = slice(40 - target.left, 50 - target.left)
        rows = slice(36 - target.top, 38 - target.top)
        assert bool(target.known[rows, columns].all()) is counted
        assert not target.inside[:, columns].any()


def test_depth_is_averaged_within_the_object_and_not_over_its_steps() -> None:
    rng = np.random.default_rng(0)
    exact = np.where(np.arange(60)[None, :] < 30, 0.5, 0.6) * np.ones((40, 1))
    inside = np.ones((40, 60), dtype=bool)
    inside[:10] = False
    noisy = exact + rng.normal(0, 2e-3, exact.shape)
    found = smoothed(noisy, inside)
    away = inside & (np.abs(np.arange(60) - 29.5) > 8)
    assert np.std((found - exact)[away]) < 0.5e-3
    assert np.abs(found - exact).max() < 0.02
    np.testing.assert_array_equal(found[:10], noisy[:10])


def test_what_cannot_be_fitted_is_refused_with_its_numbers() -> None:
    view, _ = shown(CAMERA)
    with pytest.raises(SplatNotFitted, match="none was given"):
        fit_splat([])
    with pytest.raises(SplatNotFitted, match="none of 1 views has depth"):
        fit_splat([replace(view, depth=None)])
    with pytest.raises(SplatNotFitted, match="0 of 3 points lie on the object"):
        start_from_points(np.array([[9.0, 0, 0], [8.0, 0, 0], [np.nan, 0, 0], [7.0, 0, 0]]), [view], 100)
    with pytest.raises(SplatNotFitted, match=r"mask has shape \(3, 4\), its picture \(72, 96\)"):
        replace(view, mask=np.ones((3, 4), dtype=bool))
    with pytest.raises(SplatNotFitted, match="no pixel"):
        replace(view, mask=np.zeros((72, 96), dtype=bool))
    with pytest.raises(SplatNotFitted, match=r"\(72, 96, 3\) uint8 .* float64"):
        replace(view, picture=view.picture / 255.0)
    with pytest.raises(ValueError, match="0 steps of 5 Gaussians"):
        SplatConfig(steps=0, most=5)
    with pytest.raises(ValueError, match=r"1\.5 of the SSIM"):
        SplatConfig(similarity=1.5)
