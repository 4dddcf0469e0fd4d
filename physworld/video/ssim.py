"""SSIM (Wang et al. 2004) of two pictures in torch, for fits: differentiable, with the Gaussian window of 11 px."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d

_SIGMA_PX, _REACH_PX = 1.5, 5
_C1, _C2 = 0.01**2, 0.03**2


def structural_similarity_of(one: Tensor, other: Tensor) -> Tensor:
    """Mean SSIM of two pictures (H, W, 3) in [0, 1]; beyond their edges both are 0.

    Args:
        one, other: same shape and type.
    """
    place = torch.arange(-_REACH_PX, _REACH_PX + 1, dtype=one.dtype)
    window = torch.exp(-0.5 * (place / _SIGMA_PX) ** 2)
    window = window / window.sum()

    pair = [picture.permute(2, 0, 1)[:, None] for picture in (one, other)]
    stack = torch.cat([*pair, pair[0] * pair[0], pair[1] * pair[1], pair[0] * pair[1]])
    stack = conv2d(stack, window[None, None, :, None], padding=(_REACH_PX, 0))
    stack = conv2d(stack, window[None, None, None, :], padding=(0, _REACH_PX))
    mean, mean_other, square, square_other, product = stack.reshape(5, 3, *one.shape[:2])
    spread = square - mean**2
    spread_other = square_other - mean_other**2
    together = product - mean * mean_other
    similar = (2 * mean * mean_other + _C1) * (2 * together + _C2)
    alike = similar / ((mean**2 + mean_other**2 + _C1) * (spread + spread_other + _C2))
    mean_of_all: Tensor = alike.mean()
    return mean_of_all
