"""The message sum of one layer: what every vertex hears along its edges, differentiable.

    out_i = Σ_{e into i} relu(heard_i + sent_{s(e)} + bias_e + length_e · weight)

Shapes: heard, sent (V, B, H); bias (E, H); length (E, B); weight (H,); out (V, B, H). On a CPU in single
precision the native rows of ``message_kernels`` do it, elsewhere and in double precision plain torch does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class EdgeList:
    """Edges grouped by receiver: ``offsets`` (V + 1,), ``senders`` (E,) and ``receivers`` (E,), int32."""

    offsets: Tensor
    senders: Tensor
    receivers: Tensor

    @classmethod
    def from_neighbours(cls, neighbours: np.ndarray, taken: np.ndarray | bool = True) -> EdgeList:
        """From a slot table (V, D) in which V marks an empty slot; only the slots in ``taken`` (V, D)."""
        filled = (neighbours < neighbours.shape[0]) & taken
        receivers = np.nonzero(filled)[0]
        offsets = np.concatenate([[0], np.cumsum(filled.sum(axis=1))])
        return cls(
            torch.as_tensor(offsets, dtype=torch.int32),
            torch.as_tensor(neighbours[filled], dtype=torch.int32),
            torch.as_tensor(receivers, dtype=torch.int32),
        )


def sum_messages(
    edges: EdgeList, heard: Tensor, sent: Tensor, bias: Tensor, length: Tensor, weight: Tensor
) -> Tensor:
    """Summed messages of every vertex, (V, B, H)."""
    if heard.device.type == "cpu" and heard.dtype == torch.float32:
        return _NativeSum.apply(edges, heard, sent, bias, length, weight)
    return sum_messages_torch(edges, heard, sent, bias, length, weight)


def sum_messages_torch(
    edges: EdgeList, heard: Tensor, sent: Tensor, bias: Tensor, length: Tensor, weight: Tensor
) -> Tensor:
    """The same in plain torch, on any device and in any precision."""
    along = sent.index_select(0, edges.senders) + heard.index_select(0, edges.receivers)
    messages = torch.relu(along + bias[:, None] + length[..., None] * weight)
    return torch.zeros_like(heard).index_add(0, edges.receivers, messages)


class _NativeSum(torch.autograd.Function):
    """Warp rows, forward and adjoint; keeps the inputs only."""

    @staticmethod
    def forward(
        ctx: Any, edges: EdgeList, heard: Tensor, sent: Tensor, bias: Tensor, length: Tensor, weight: Tensor
    ) -> Tensor:
        inputs = tuple(x.contiguous() for x in (heard, sent, bias, length, weight))
        ctx.edges = edges
        ctx.save_for_backward(*inputs)
        out = torch.empty_like(inputs[0])
        _launch("message_sum", edges, (*inputs, out), out.shape)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        grads = tuple(torch.zeros_like(x) for x in inputs)
        _launch("message_sum_adjoint", ctx.edges, (*inputs, grad.contiguous(), *grads), grad.shape)
        return (None, *grads)


def _launch(name: str, edges: EdgeList, tensors: tuple[Tensor, ...], shape: torch.Size) -> None:
    """One launch on the addresses of contiguous tensors."""
    warp, kernels = _warp(), _kernels()
    arguments = [*shape, edges.offsets.data_ptr(), edges.senders.data_ptr(), *(x.data_ptr() for x in tensors)]
    warp.launch(getattr(kernels, name), dim=1, inputs=arguments, device="cpu", record_tape=False)


@cache
def _warp() -> ModuleType:
    """Warp, initialised without its banner; imported late, since importing it takes a second."""
    import warp

    warp.config.quiet = True
    warp.init()
    return warp


@cache
def _kernels() -> ModuleType:
    from physworld.worldmodel import message_kernels

    return message_kernels
