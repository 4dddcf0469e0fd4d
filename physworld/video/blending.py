"""The blending of projected Gaussians: run by one Warp kernel, and its gradient by another (Kerbl et al. 2023).

Warp's own adjoint of a loop whose length depends on data forgets what the loop overwrote, so the adjoint is written
out: with V the weighted sum of a pixel, the derivative to a Gaussian's alpha needs only what lies behind it, which is
V less what was summed before it. Both kernels walk from front to back.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from physworld.arrays import Array
from physworld.devices import default_device
from physworld.video.render_kernels import TILE, blend, blend_adjoint, blend_rows

_WORTH_SHARING_PX = 1 << 16
"""Pictures of fewer pixels are drawn in one piece."""
_MOST_BANDS = 8


@dataclass(frozen=True)
class Canvas:
    """What is drawn on.

    Attributes:
        width, height: [px].
        starts, order: of ``projection.tiles``.
        background: colour where nothing is, in [0, 1].
        device: Warp device.
    """

    width: int
    height: int
    starts: Array
    order: Array
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    device: str = field(default_factory=default_device)

    def arrays(self, *given: Array) -> list[Any]:
        """Warp arrays of tiles, centres, conics, opacities, colours and depths."""
        kinds = (wp.int32, wp.int32, wp.vec2f, wp.vec3f, wp.float32, wp.vec3f, wp.float32)
        plain = (np.int32, np.int32, *(np.float32,) * 5)
        return [
            wp.array(np.ascontiguousarray(values, dtype=numbers), dtype=kind, device=self.device)
            for values, kind, numbers in zip((self.starts, self.order, *given), kinds, plain, strict=True)
        ]


def blended(canvas: Canvas, inputs: list[Any], by_pixel: bool | None = None) -> list[Any]:
    """Colour (H·W,) of three, coverage and sum of depths (H·W,), as Warp arrays.

    Args:
        canvas: what is drawn on.
        inputs: of ``Canvas.arrays``.
        by_pixel: a thread for every pixel instead of one for a row of a tile; None: on CUDA.
    """
    pixels = canvas.width * canvas.height
    outputs = [
        wp.zeros(pixels, dtype=kind, device=canvas.device) for kind in (wp.vec3f, wp.float32, wp.float32)
    ]
    across = -(-canvas.width // TILE)
    shared = [canvas.width, across, *inputs, wp.vec3f(*canvas.background), *outputs]
    if wp.get_device(canvas.device).is_cuda if by_pixel is None else by_pixel:
        wp.launch(blend, dim=pixels, inputs=shared, device=canvas.device)
        return outputs

    def draw(band: tuple[int, int]) -> None:
        first, end = (row * across for row in band)
        wp.launch(blend_rows, dim=end - first, inputs=[first, *shared], device=canvas.device)

    bands = _bands(canvas)
    if len(bands) == 1:
        draw(bands[0])
        return outputs
    wp.load_module(blend.module.name, device=canvas.device)  # once, before threads ask for it
    with ThreadPoolExecutor(len(bands)) as threads:
        list(threads.map(draw, bands))
    return outputs


def _bands(canvas: Canvas) -> list[tuple[int, int]]:
    """Ranges of rows of pixels that are drawn side by side on the processor: one a core, each of whole rows of tiles.

    A kernel on the processor runs in the thread that launches it, and leaves the interpreter to the others.
    """
    rows = -(-canvas.height // TILE)
    count = 1
    if canvas.width * canvas.height >= _WORTH_SHARING_PX:
        count = min(len(os.sched_getaffinity(0)), _MOST_BANDS, rows)
    return list(pairwise([*(TILE * (rows * k // count) for k in range(count)), canvas.height]))


class Blend(torch.autograd.Function):
    """``Blend.apply(centre, conic, opacity, colour, depth, canvas)``: colour (H, W, 3), coverage and summed depth
    [m] (H, W), with derivatives to the first five."""

    @staticmethod
    def forward(
        ctx: Any,
        centre: Tensor,
        conic: Tensor,
        opacity: Tensor,
        colour: Tensor,
        depth: Tensor,
        canvas: Canvas,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Draw.

        Args:
            ctx: of the autograd function.
            centre: of the projected Gaussians [px], (G, 2).
            conic: upper triangle of the inverse covariances [1/px²], (G, 3).
            opacity: (G,).
            colour: (G, 3).
            depth: along the camera's axis [m], (G,).
            canvas: what is drawn on.
        """
        given = [tensor.detach().numpy() for tensor in (centre, conic, opacity, colour, depth)]
        ctx.inputs = canvas.arrays(*given)
        ctx.canvas = canvas
        ctx.outputs = blended(canvas, ctx.inputs)
        shape = (canvas.height, canvas.width)
        rgb, alpha, far = (torch.from_numpy(output.numpy()).double() for output in ctx.outputs)
        return rgb.reshape(*shape, 3), alpha.reshape(shape), far.reshape(shape)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """The derivatives of a function of the picture, from those to the picture."""
        canvas, inputs = ctx.canvas, ctx.inputs
        device = canvas.device
        count = len(inputs[2])
        kinds = (wp.vec3f, wp.float32, wp.float32)
        asked = [
            wp.array(
                np.ascontiguousarray(
                    gradient.numpy().reshape(-1, 3) if kind is wp.vec3f else gradient.numpy().ravel(),
                    dtype=np.float32,
                ),
                dtype=kind,
                device=device,
            )
            for gradient, kind in zip(gradients, kinds, strict=True)
        ]
        kinds_out = (wp.vec2f, wp.vec3f, wp.float32, wp.vec3f, wp.float32)
        found = [wp.zeros(count, dtype=kind, device=device) for kind in kinds_out]
        wp.launch(
            blend_adjoint,
            dim=canvas.width * canvas.height,
            inputs=[
                canvas.width, -(-canvas.width // TILE), *inputs, *ctx.outputs, *asked, *found,
            ],
            device=device,
        )  # fmt: skip
        return (*(torch.from_numpy(array.numpy()).double() for array in found), None)
