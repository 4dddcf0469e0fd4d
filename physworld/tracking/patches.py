"""Patches of the first frame found again in a later one: what keeps tracks from drifting.

A point's patch of the first frame is compared with the present picture through the affine map that its neighbours
give, and its place is refined by Lucas-Kanade in the inverse compositional form (Baker & Matthews 2004), brightness and
contrast free, pixels of the patch that were not on the object left out. OpenCV's tracker has neither of the last two.
The normalised correlation at the end says whether it is still the same patch.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from physworld.arrays import Array
from physworld.tracking.view import to_opencv

ITERATIONS = 8
FLAT = 1.5
"""Deviation of a patch's brightness (of 255) below which there is nothing to find."""


@dataclass(frozen=True)
class Patches:
    """Templates of N points.

    Attributes:
        offsets: of a patch's pixels from its middle, (P, 2) [px].
        weights: 0 off the object, else falling towards the rim, (N, P), sum 1.
        values: brightness of mean 0 and deviation 1, (N, P).
        slopes: along x and y [1/px], (N, P, 2).
        usable: enough pixels, contrast, and slopes in both directions, (N,) bool.
    """

    offsets: Array
    weights: Array
    values: Array
    slopes: Array
    usable: Array


def cut(grey: Array, mask: Array, pixels: Array, radius: int, blur_px: float = 0.0) -> Patches:
    """Templates at ``pixels`` of the first frame.

    Args:
        grey: (H, W) float32, 0 to 255.
        mask: the object, (H, W) bool.
        pixels: (N, 2).
        radius: half the side of a patch [px].
        blur_px: deviation of a blur for a coarse search.
    """
    side = np.arange(-radius, radius + 1)
    offsets = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2).astype(np.float64)
    picture = _blurred(grey, blur_px)
    at = pixels[:, None] + offsets
    inside = _sample(mask.astype(np.float32), at) > 0.5
    bell = np.exp(-0.5 * (offsets**2).sum(axis=1) / (0.6 * radius) ** 2)
    weights = inside * bell
    total = weights.sum(axis=1)
    weights = weights / np.maximum(total, 1e-9)[:, None]
    values, deviation = _normalised(_sample(picture, at), weights)
    slopes = np.stack(
        [_sample(cv2.Scharr(picture, cv2.CV_32F, *axis) / 32.0, at) for axis in ((1, 0), (0, 1))], axis=-1
    )
    slopes = slopes / np.maximum(deviation, FLAT)[:, None, None]
    normal = np.einsum("np,npi,npj->nij", weights, slopes, slopes)
    least = np.linalg.eigvalsh(normal)[:, 0]
    usable = (total > 0.3 * bell.sum()) & (deviation > FLAT) & (least > 1e-4)
    return Patches(offsets, weights, values, slopes, usable)


def find(
    grey: Array, patches: Patches, guess: Array, maps: Array, blur_px: float = 0.0
) -> tuple[Array, Array]:
    """Places (N, 2) of the patches in a picture and their correlation there (N,), -1 where there is none.

    Args:
        grey: (H, W) float32, 0 to 255.
        patches: of the first frame.
        guess: pixels from which the search begins, (N, 2).
        maps: of a patch's surroundings since the first frame, (N, 2, 2).
        blur_px: the same as of the patches.
    """
    picture = _blurred(grey, blur_px)
    weighted = patches.weights[..., None] * patches.slopes
    normal = weighted.transpose(0, 2, 1) @ patches.slopes
    inverse = np.linalg.inv(normal + 1e-6 * np.eye(2))
    spread = np.tensordot(maps, patches.offsets, axes=(2, 1)).transpose(0, 2, 1)
    places, correlation = np.array(guess, dtype=np.float64), np.full(len(guess), -1.0)
    for _ in range(ITERATIONS):
        values, _ = _normalised(_sample(picture, places[:, None] + spread), patches.weights)
        miss = values - patches.values
        step = np.clip((miss[:, None] @ weighted @ inverse.transpose(0, 2, 1))[:, 0], -2.0, 2.0)
        places = places - (maps @ step[..., None])[..., 0]
    values, _ = _normalised(_sample(picture, places[:, None] + spread), patches.weights)
    correlation = (patches.weights * values * patches.values).sum(axis=1)
    height, width = grey.shape
    inside = ((places > 2) & (places < [width - 2, height - 2])).all(axis=1)
    return places, np.where(inside & patches.usable, correlation, -1.0)


def _blurred(grey: Array, blur_px: float) -> Array:
    return cv2.GaussianBlur(grey, (0, 0), blur_px) if blur_px > 0 else grey


def _sample(picture: Array, at: Array) -> Array:
    """Bilinear values (N, P) of a picture (H, W) at pixels (N, P, 2)."""
    places = to_opencv(at)
    values: Array = cv2.remap(
        picture,
        np.ascontiguousarray(places[..., 0]),
        np.ascontiguousarray(places[..., 1]),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float64)
    return values


def _normalised(values: Array, weights: Array) -> tuple[Array, Array]:
    """Values of weighted mean 0 and deviation 1 (N, P), and the deviation (N,)."""
    centred = values - np.vecdot(weights, values)[:, None]
    deviation = np.sqrt(np.vecdot(weights, centred * centred))
    return centred / np.maximum(deviation, 1e-6)[:, None], deviation
