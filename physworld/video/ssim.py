"""SSIM (Wang et al. 2004) of two pictures in torch, for fits: differentiable, with the Gaussian window of 11 px.

OpenCV takes the means: on a CPU a convolution of so few channels in torch takes most of a fit.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

_SIGMA_PX, _REACH_PX = 1.5, 5
_WINDOW = np.exp(-0.5 * (np.arange(-_REACH_PX, _REACH_PX + 1) / _SIGMA_PX) ** 2)
_WINDOW /= _WINDOW.sum()
_C1, _C2 = 0.01**2, 0.03**2


class _Windowed(torch.autograd.Function):
    """Means of pictures (K, H, W) under the window; the map is symmetric, so its gradient is the map itself."""

    @staticmethod
    def forward(_: Any, pictures: Tensor) -> Tensor:
        return _means(pictures)

    @staticmethod
    def backward(_: Any, *gradients: Tensor) -> Tensor:
        return _means(gradients[0])


def _means(pictures: Tensor) -> Tensor:
    given = pictures.detach().contiguous().numpy()
    found = np.empty_like(given)
    for picture, mean in zip(given, found, strict=True):
        cv2.sepFilter2D(picture, -1, _WINDOW, _WINDOW, dst=mean, borderType=cv2.BORDER_CONSTANT)
    return torch.from_numpy(found)


def structural_similarity_of(one: Tensor, other: Tensor) -> Tensor:
    """Mean SSIM of two pictures (H, W, 3) in [0, 1]; beyond their edges both are 0.

    Args:
        one, other: same shape and type.
    """
    first, second = (picture.permute(2, 0, 1) for picture in (one, other))
    stack = torch.cat([first, second, first * first, second * second, first * second])
    means = _Windowed.apply(stack)  # type: ignore[no-untyped-call]
    mean, mean_other, square, square_other, product = means.reshape(5, 3, *one.shape[:2])
    spread = square - mean**2
    spread_other = square_other - mean_other**2
    together = product - mean * mean_other
    similar = (2 * mean * mean_other + _C1) * (2 * together + _C2)
    alike = similar / ((mean**2 + mean_other**2 + _C1) * (spread + spread_other + _C2))
    mean_of_all: Tensor = alike.mean()
    return mean_of_all
