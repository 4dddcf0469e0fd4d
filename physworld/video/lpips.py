"""LPIPS (Zhang et al. 2018): how differently a network that was trained on photographs sees two pictures.

Five layers of the network, each pixel's channels brought to length 1, squared differences weighted by the layer's
linear weights, averaged over the pixels and summed over the layers. Version 0.1 of the authors' code, which scales its
inputs. 0 for equal pictures; no unit. The weights are given: nothing here ships any.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, relu

from physworld.arrays import Array

LpipsNet = Literal["alexnet", "vgg16"]
NETS: tuple[LpipsNet, ...] = get_args(LpipsNet)
LEAST_SIDE_PX: dict[LpipsNet, int] = {"alexnet": 31, "vgg16": 16}
"""Of smaller pictures nothing arrives at the last layer."""

_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_TINY = 1e-10


@dataclass(frozen=True)
class _Convolution:
    """A convolution with its rectifier; ``pool`` (size, stride) before it, ``kept`` when the layer is compared."""

    shape: tuple[int, int, int]  # side of the kernel [px], channels in, channels out
    stride: int = 1
    padding: int = 1
    pool: tuple[int, int] | None = None
    kept: bool = False


def _vgg16() -> Iterator[_Convolution]:
    coming = 3
    for block, (channels, count) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))):
        for index in range(count):
            pool = (2, 2) if block and not index else None
            yield _Convolution((3, coming, channels), pool=pool, kept=index == count - 1)
            coming = channels


_LAYERS: dict[LpipsNet, tuple[_Convolution, ...]] = {
    "alexnet": (
        _Convolution((11, 3, 64), stride=4, padding=2, kept=True),
        _Convolution((5, 64, 192), padding=2, pool=(3, 2), kept=True),
        _Convolution((3, 192, 384), pool=(3, 2), kept=True),
        _Convolution((3, 384, 256), kept=True),
        _Convolution((3, 256, 256), kept=True),
    ),
    "vgg16": tuple(_vgg16()),
}


@dataclass(frozen=True)
class LpipsWeights:
    """A network's weights and those of the comparison.

    Attributes:
        net: which network.
        kernels: of its convolutions in their order, (side, side, channels in, channels out).
        biases: of the same, (channels out,).
        linear: of the five layers that are compared, (channels,), none negative.

    Raises:
        ValueError: another number of arrays, or other shapes than the network's, with both.
    """

    net: LpipsNet
    kernels: tuple[Array, ...]
    biases: tuple[Array, ...]
    linear: tuple[Array, ...]

    def __post_init__(self) -> None:
        shapes = [layer.shape for layer in _LAYERS[self.net]]
        kept = [layer.shape[2] for layer in _LAYERS[self.net] if layer.kept]
        for name, wanted in (
            ("kernels", [(side, side, coming, going) for side, coming, going in shapes]),
            ("biases", [(going,) for _, _, going in shapes]),
            ("linear", [(channels,) for channels in kept]),
        ):
            found = [array.shape for array in getattr(self, name)]
            if found != wanted:
                raise ValueError(f"the {name} of {self.net} have shapes {found}, not {wanted}")


class Lpips:
    """The distance of two pictures (H, W, 3) in [0, 1], as ``compare_frames`` takes it."""

    def __init__(self, weights: LpipsWeights, device: str = "cpu") -> None:
        self.net = weights.net
        self.device = device
        self._kernels = [self._tensor(np.transpose(kernel, (3, 2, 0, 1))) for kernel in weights.kernels]
        self._biases = [self._tensor(bias) for bias in weights.biases]
        self._linear = [self._tensor(linear)[:, None, None] for linear in weights.linear]
        self._shift, self._scale = (self._tensor(np.array(x))[:, None, None] for x in (_SHIFT, _SCALE))

    def __call__(self, one: Array, other: Array) -> float:
        """The sum over the layers."""
        return float(self.by_layer(one, other).sum())

    def by_layer(self, one: Array, other: Array) -> Array:
        """What each of the five layers adds (5,).

        Args:
            one, other: pictures (H, W, 3) in [0, 1].

        Raises:
            ValueError: shapes that disagree, or pictures too small for the network, with their sizes.
        """
        if one.shape != other.shape or one.ndim != 3 or one.shape[2] != 3:
            raise ValueError(
                f"two pictures (H, W, 3) of one size are compared, got {one.shape} and {other.shape}"
            )
        least = LEAST_SIDE_PX[self.net]
        if min(one.shape[:2]) < least:
            raise ValueError(
                f"pictures of {one.shape[1]} x {one.shape[0]} px; LPIPS by {self.net} needs {least} px"
            )
        with torch.no_grad():
            pair = self._tensor(np.stack([one, other]).transpose(0, 3, 1, 2))
            layers = self._layers((2.0 * pair - 1.0 - self._shift) / self._scale)
            found = [
                self._compared(layer, linear) for layer, linear in zip(layers, self._linear, strict=True)
            ]
        return np.array(found)

    def _layers(self, pictures: Tensor) -> Iterator[Tensor]:
        """The layers that are compared, (2, channels, h, w) each."""
        seen = pictures
        for layer, kernel, bias in zip(_LAYERS[self.net], self._kernels, self._biases, strict=True):
            if layer.pool is not None:
                seen = max_pool2d(seen, layer.pool[0], layer.pool[1])
            seen = relu(conv2d(seen, kernel, bias, layer.stride, layer.padding))
            if layer.kept:
                yield seen

    @staticmethod
    def _compared(layer: Tensor, linear: Tensor) -> float:
        unit = layer / (layer.square().sum(dim=1, keepdim=True).sqrt() + _TINY)
        return float(((unit[0] - unit[1]).square() * linear).sum(dim=0).mean())

    def _tensor(self, values: Array) -> Tensor:
        return torch.as_tensor(np.array(values, dtype=np.float32, order="C"), device=self.device)
