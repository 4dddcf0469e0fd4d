"""The training loss of a batch of sub-sequences and its gradient, on a CPU or a GPU.

    loss = mean_b Σ_{i=1..τ} ‖x_pred^{t+i} - x^{t+i}‖² / (Σ_{i=1..τ} ‖x̂^{t+i} - x^{t+i}‖² + τ σ_change²)

x̂ is the prior unrolled alone from the same frame: a sub-sequence counts by the share of the prior's error that is left,
so that the few in which small errors grow fast do not drown the others.

A sub-sequence is thousands of small operations, and a GPU would wait for Python between them. There the loss and its
gradient are recorded once for a size of batch, as a CUDA graph, and launched as one (``GraphedLoss``). NEAR edges of
the current shape are searched on the CPU at every step, so that such a model is not recorded.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from physworld.worldmodel.model.frame import turns_ahead
from physworld.worldmodel.model.model import WorldModel

_WARM_UP = 2  # runs before a recording, in which what is kept on the device gets there


class Loss(Protocol):
    """Computes the loss of a batch and leaves its gradient in the model's parameters."""

    def __call__(self, model: WorldModel, window: Tensor, truth: Tensor, phi: Tensor) -> Tensor:
        """The loss, a scalar on the model's device.

        Args:
            model: whose parameters get the gradient, in place of what they had.
            window: first h + 1 frames [m], (h+1, V, B, 3), on the CPU or the model's device.
            truth: the τ frames after them [m], (τ, V, B, 3).
            phi: logarithms of property ratios (n, B, ·).
        """
        ...


def unrolled_loss(model: WorldModel, window: Tensor, truth: Tensor, phi: Tensor) -> Tensor:
    """The loss of the module's text; the arguments are those of :class:`Loss`, all on the model's device."""
    n, constants = model.spec.object_count, model.edge_constants()
    alone = window
    left = beside = window.new_zeros(window.shape[2])
    for following, turn in zip(truth, turns_ahead(model.spec.frame, truth[:, n:]), strict=True):
        predicted = model.step(window, following[n:], phi, constants, turn)
        left = left + _squared(predicted[:n] - following[:n])
        window = torch.cat([window[1:], predicted[None]])
        with torch.no_grad():
            ahead = model.prior_ahead(alone, following[n:], phi, turn)
            beside = beside + _squared(ahead - following[:n])
            alone = torch.cat([alone[1:], torch.cat([ahead, following[n:]])[None]])
    return (left / (beside + len(truth) * model.norm.change.square())).mean()


def plain_loss(model: WorldModel, window: Tensor, truth: Tensor, phi: Tensor) -> Tensor:
    """A loss operation by operation, on any device; the arguments are those of :class:`Loss`."""
    device = model.norm.change.device
    model.zero_grad(set_to_none=True)
    loss = unrolled_loss(model, window.to(device), truth.to(device), phi.to(device))
    loss.backward()  # type: ignore[no-untyped-call]  # torch's has no types
    return loss.detach()


class GraphedLoss:
    """A :class:`Loss` as one launch on CUDA, recorded anew where the shapes of a batch change."""

    def __init__(self) -> None:
        self._shapes: tuple[torch.Size, ...] = ()
        self._inputs: tuple[Tensor, ...] = ()

    @staticmethod
    def fits(model: WorldModel) -> bool:
        """Whether a model can be recorded."""
        return model.norm.change.is_cuda and not model.spec.current_neighbours

    def __call__(self, model: WorldModel, window: Tensor, truth: Tensor, phi: Tensor) -> Tensor:
        """See :class:`Loss`."""
        batch = (window, truth, phi)
        shapes = tuple(part.shape for part in batch)
        if shapes != self._shapes:
            self._record(model, batch)
            self._shapes = shapes
        for kept, part in zip(self._inputs, batch, strict=True):
            kept.copy_(part)
        self._graph.replay()
        return self._loss

    def _record(self, model: WorldModel, batch: tuple[Tensor, ...]) -> None:
        device = model.norm.change.device
        self._inputs = tuple(part.to(device, copy=True) for part in batch)
        aside = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]  # torch's has no types
        aside.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(aside):
            for _ in range(_WARM_UP):
                plain_loss(model, *self._inputs)
        torch.cuda.current_stream(device).wait_stream(aside)
        model.zero_grad(set_to_none=True)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.device(device), torch.cuda.graph(self._graph):
            loss = unrolled_loss(model, *self._inputs)
            loss.backward()  # type: ignore[no-untyped-call]
        self._loss = loss.detach()


def _squared(gap: Tensor) -> Tensor:
    """Mean over vertices of the squared length of (n, B, 3), (B,)."""
    return gap.square().sum(dim=-1).mean(dim=0)
