"""Gaussians in a camera's picture, differentiable: the one projection that pictures and fits are made with.

A Gaussian N(p, Σ) seen by a pinhole camera is, to first order in its size, a Gaussian in the picture with
Σ' = J W Σ Wᵀ Jᵀ + 0.3 px² I (Zwicker et al. 2001, "EWA splatting"), W the camera's rotation and J the projection's
derivative at p. Tensors are double: torch's gradients of them are exact, and the kernels take single precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from physworld.arrays import Array
from physworld.camera import Camera
from physworld.video.render_kernels import TILE

NEAR_M = 1e-2
BLUR_PX2 = 0.3
BEYOND = 1.3  # tangents outside of the picture's, at which the projection's derivative is held
REACH = 3.0  # standard deviations that a splat covers
MOST_PAIRS = 100_000_000


@dataclass(frozen=True)
class Projected:
    """G Gaussians in a picture.

    Attributes:
        centre: (G, 2) [px].
        conic: Σ'⁻¹ as (xx, xy, yy), (G, 3) [1/px²].
        depth: along the camera's axis, (G,) [m].
        reach: half the width and height of what a splat covers, (G, 2) [px], detached.
        good: which of them can be drawn, (G,) bool, detached.
    """

    centre: Tensor
    conic: Tensor
    depth: Tensor
    reach: Array
    good: Array


def project(means: Tensor, log_scales: Tensor, rotations: Tensor, camera: Camera) -> Projected:
    """The Gaussians as the camera sees them.

    Args:
        means: (G, 3) [m], double.
        log_scales: logarithms of the standard deviations along their own axes, (G, 3) [log m].
        rotations: unit quaternions (w, x, y, z), own axes to the world's, (G, 4).
        camera: where from.
    """
    pose = torch.from_numpy(camera.world_to_camera)
    local = means @ pose[:3, :3].T + pose[:3, 3]
    front = local[:, 2] > NEAR_M
    depth = local[:, 2].clamp(min=NEAR_M)
    tangents = local[:, :2] / depth[:, None]
    limit = torch.tensor([camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)]).double() * BEYOND
    held = torch.maximum(torch.minimum(tangents, limit), -limit)
    axes = (pose[:3, :3] @ matrices(rotations)) * torch.exp(log_scales)[:, None, :]
    rows = [
        focal / depth[:, None] * (axes[:, axis] - held[:, axis, None] * axes[:, 2])
        for axis, focal in enumerate((camera.fx, camera.fy))
    ]
    xx, yy = ((row * row).sum(dim=1) + BLUR_PX2 for row in rows)
    xy = (rows[0] * rows[1]).sum(dim=1)
    determinant = xx * yy - xy * xy
    focal = torch.tensor([camera.fx, camera.fy]).double()
    middle = torch.tensor([camera.cx, camera.cy]).double()
    safe = torch.where(determinant > 0, determinant, torch.ones_like(determinant))
    with torch.no_grad():
        reach = REACH * torch.sqrt(torch.stack([xx, yy], dim=1))
        good = front & (determinant > 0) & torch.isfinite(reach).all(dim=1)
    return Projected(
        tangents * focal + middle,
        torch.stack([yy, -xy, xx], dim=1) / safe[:, None],
        local[:, 2],
        reach.numpy(),
        good.numpy(),
    )


def tiles(
    centre: Array, reach: Array, depth: Array, good: Array, width: int, height: int
) -> tuple[Array, Array]:
    """Gaussians of every tile, nearest first: ``order``, and where those of each tile begin, (tiles + 1,).

    Args:
        centre: (G, 2) [px].
        reach: half the width and height that each covers, (G, 2) [px].
        depth: (G,) [m].
        good: which are drawn, (G,) bool.
        width, height: of the picture [px].

    Raises:
        ValueError: more than ``MOST_PAIRS`` pairs of a splat and a tile.
    """
    across, down = -(-width // TILE), -(-height // TILE)
    number = np.flatnonzero(good)
    number = number[np.argsort(depth[number], kind="stable")]
    with np.errstate(invalid="ignore", over="ignore"):
        low = np.floor((centre[number] - reach[number]) / TILE)
        high = np.floor((centre[number] + reach[number]) / TILE) + 1
    low = np.clip(low, 0, [across, down]).astype(np.int64)
    high = np.clip(high, 0, [across, down]).astype(np.int64)
    size = np.maximum(high - low, 0)
    count = size[:, 0] * size[:, 1]
    if count.sum() > MOST_PAIRS:
        raise ValueError(
            f"{count.sum()} pairs of splat and tile, more than {MOST_PAIRS}: splats of up to "
            f"{reach[number].max():.3g} px"
        )
    which = np.repeat(np.arange(len(number)), count)
    place = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    down_by, right_by = np.divmod(place, np.maximum(size[which, 0], 1))
    tile = (low[which, 1] + down_by) * across + low[which, 0] + right_by
    # numpy sorts small integers by their digits, and pairs are in the order of depth already
    small = tile.astype(np.uint16) if across * down <= 1 << 16 else tile
    sorted_pairs = np.argsort(small, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(tile, minlength=across * down))])
    return starts, number[which[sorted_pairs]]


def matrices(quaternions: Tensor) -> Tensor:
    """Rotations (G, 3, 3) of unit quaternions (G, 4), (w, x, y, z)."""
    w, x, y, z = quaternions.unbind(dim=1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=1),
    ]
    return torch.stack(rows, dim=1)
