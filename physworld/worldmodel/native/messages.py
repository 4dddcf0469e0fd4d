"""The mean message of one layer: what every vertex hears along its edges, differentiable.

    out_{k,i} = mean_{e of kind k into i} relu(heard_{k,i} + sent_{k,s(e)} + bias_e + length_e · weight_k)

Shapes: heard, sent, out (K, V, B, H); bias (E, H); length (E, B); weight (K, H), for K kinds.
On a CPU in single precision the native rows of ``message_kernels`` do it, elsewhere and in double precision
plain torch does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from physworld.arrays import Array


@dataclass(frozen=True)
class EdgeList:
    """Edges of K kinds, by kind and then by receiver; ends count from 0 to K·V, kind by kind; int32.

    Attributes:
        offsets: first edge of each receiver, (K·V + 1,).
        senders, receivers: (E,).
        order: rows of ``neighbours`` (V, D), flattened, that the edges were, (E,).
    """

    offsets: Tensor
    senders: Tensor
    receivers: Tensor
    order: Array
    _elsewhere: dict[torch.device, tuple[Tensor, Tensor, Tensor]] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )

    def on(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
        """Senders, receivers and the receivers' number of edges, at least 1, on a device: copied to it once."""
        if device not in self._elsewhere:
            with torch.inference_mode(False):  # so that gradients may be taken with them
                degree = self.offsets.diff().clamp(min=1)
                self._elsewhere[device] = (
                    self.senders.to(device),
                    self.receivers.to(device),
                    degree.to(device),
                )
        return self._elsewhere[device]

    @classmethod
    def from_neighbours(cls, neighbours: Array, kind: Array, kinds: int) -> EdgeList:
        """From a slot table (V, D) in which V marks an empty slot, and the slots' kinds (V, D)."""
        vertex_count = neighbours.shape[0]
        receiver, slot = np.nonzero(neighbours < vertex_count)
        shift = vertex_count * kind[receiver, slot]
        order = np.argsort(shift + receiver, kind="stable")
        receiver, slot, shift = receiver[order], slot[order], shift[order]
        degree = np.bincount(shift + receiver, minlength=kinds * vertex_count)
        return cls(
            torch.as_tensor(np.concatenate([[0], np.cumsum(degree)]), dtype=torch.int32),
            torch.as_tensor(shift + neighbours[receiver, slot], dtype=torch.int32),
            torch.as_tensor(shift + receiver, dtype=torch.int32),
            receiver * neighbours.shape[1] + slot,
        )


def mean_messages(
    edges: EdgeList, heard: Tensor, sent: Tensor, bias: Tensor, length: Tensor, weight: Tensor
) -> Tensor:
    """Mean messages of every vertex, by kind, (K, V, B, H); 0 where it has no edge of that kind.

    Args:
        edges: sorted by kind and receiver, E of one copy's graph.
        heard: what receivers add (K, V, B, H).
        sent: what senders add (K, V, B, H).
        bias: of the edges (E, H).
        length: of the edges at present (E, B) [m].
        weight: of the length (K, H).
    """
    if heard.device.type == "cpu" and heard.dtype == torch.float32:
        return _native_mean(edges, heard, sent, bias, length, weight)
    return mean_messages_torch(edges, heard, sent, bias, length, weight)


def mean_messages_torch(
    edges: EdgeList, heard: Tensor, sent: Tensor, bias: Tensor, length: Tensor, weight: Tensor
) -> Tensor:
    """The same in plain torch, on any device and in any precision: the arguments of :func:`mean_messages`."""
    senders, receivers, degree = edges.on(heard.device)
    along = sent.flatten(0, 1).index_select(0, senders) + heard.flatten(0, 1).index_select(0, receivers)
    weights = weight.index_select(0, receivers // heard.shape[1])
    messages = torch.relu(along + bias[:, None] + length[..., None] * weights[:, None])
    total = torch.zeros_like(heard).flatten(0, 1).index_add(0, receivers, messages)
    return (total / degree[:, None, None]).view_as(heard)


class _NativeMean(torch.autograd.Function):
    """Warp rows, forward and adjoint; keeps the inputs only."""

    @staticmethod
    def forward(
        ctx: Any, edges: EdgeList, heard: Tensor, sent: Tensor, bias: Tensor, length: Tensor, weight: Tensor
    ) -> Tensor:
        inputs = tuple(x.contiguous() for x in (heard, sent, bias, length, weight))
        ctx.edges = edges
        ctx.save_for_backward(*inputs)
        out = torch.empty_like(inputs[0])
        _launch("message_mean", edges, (*inputs, out), out.shape)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        grads = (torch.empty_like(inputs[0]), *(torch.zeros_like(x) for x in inputs[1:]))
        _launch("message_mean_adjoint", ctx.edges, (*inputs, grad.contiguous(), *grads), grad.shape)
        return (None, *grads)


class _AsSeen(torch.autograd.Function):
    """``heard - placed`` and ``sent + placed``, (K, V, B, H), of heard and sent (V, B, H)."""

    @staticmethod
    def forward(ctx: Any, heard: Tensor, sent: Tensor, placed: Tensor) -> tuple[Tensor, Tensor]:
        return heard - placed, sent + placed

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        heard, sent = grads
        return heard.sum(0), sent.sum(0), sent - heard  # autograd's own way takes a pass more


_native_mean: Callable[..., Tensor] = _NativeMean.apply
_as_seen: Callable[..., tuple[Tensor, Tensor]] = _AsSeen.apply


def as_seen(heard: Tensor, sent: Tensor, placed: Tensor) -> tuple[Tensor, Tensor]:
    """What is heard and sent (V, B, H) with the places of both ends (K, V, B, H), of which the difference counts."""
    return _as_seen(heard, sent, placed)


def _launch(name: str, edges: EdgeList, tensors: tuple[Tensor, ...], shape: torch.Size) -> None:
    """One launch on the addresses of contiguous tensors."""
    warp, kernels = warp_module(), _kernels()
    kinds, vertices, batch, hidden = shape
    sizes = [kinds * vertices, batch, hidden, kinds]
    arguments = [*sizes, edges.offsets.data_ptr(), edges.senders.data_ptr(), *(x.data_ptr() for x in tensors)]
    warp.launch(getattr(kernels, name), dim=1, inputs=arguments, device="cpu", record_tape=False)


@cache
def warp_module() -> ModuleType:
    """Warp, initialised without its banner; imported late, since importing it takes a second."""
    import warp

    warp.config.quiet = True
    warp.init()
    module: ModuleType = warp
    return module


@cache
def _kernels() -> ModuleType:
    from physworld.worldmodel.native import message_kernels

    return message_kernels
