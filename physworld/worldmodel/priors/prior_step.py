"""The step of a prior as a module of the network: what x̂^{t+1} is computed with, by the kind of prior."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor, nn

from physworld.arrays import Array
from physworld.worldmodel.model.frame import Turn, enter, leave
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.inertia import InertialPrior, InertialStep, one_step_residual
from physworld.worldmodel.priors.chain import ChainPrior
from physworld.worldmodel.priors.chain_step import ChainStep
from physworld.worldmodel.priors.modal import ModalPrior


class FramedPrior(Protocol):
    """A prior's step in world axes."""

    def __call__(self, window: Tensor, control_next: Tensor, phi: Tensor, turn: Turn | None = None) -> Tensor:
        """x̂^{t+1} of the object vertices [m], (n, B, 3); arguments as of ``WorldModel.step``."""
        ...


def prior_step(
    prior: ModalPrior | ChainPrior | InertialPrior, history: int
) -> PriorStep | ChainStep | InertialStep:
    """The module that computes x̂^{t+1} from ``prior``."""
    if isinstance(prior, InertialPrior):
        return InertialStep(prior, history)
    return ChainStep(prior, history) if isinstance(prior, ChainPrior) else PriorStep(prior, history)


def framed_prior(step: nn.Module, spec: GraphSpec) -> FramedPrior:
    """x̂^{t+1} in world axes by a prior's ``step``, which is taken in the grip's frame where the graph has one."""
    frame = spec.frame

    def ahead(window: Tensor, control_next: Tensor, phi: Tensor, turn: Turn | None = None) -> Tensor:
        found: Tensor
        if frame is None:
            found = step(window, control_next, phi)
            return found
        turn, local, control_local = enter(frame, window, control_next, turn)
        found = leave(frame, turn, step(local, control_local, phi))
        return found

    return ahead


class PriorStep(nn.Module):
    """The modal prior's step, in single precision; tensors ``prior.*``."""

    mean: Tensor
    basis: Tensor
    shape: Tensor
    weight: Tensor
    response: Tensor
    placing: Tensor
    span: Tensor

    def __init__(self, prior: ModalPrior, history: int) -> None:
        super().__init__()
        self.history = history
        for name in ModalPrior.__dataclass_fields__:
            self.register_buffer(name, _single(getattr(prior, name)))

    def forward(self, window: Tensor, control_next: Tensor, phi: Tensor) -> Tensor:
        """x̂^{t+1} (n, B, 3) from x^{t-h} … x^t (h+1, V, B, 3), c^{t+1} (C, B, 3) and Φ (n, B, 2)."""
        n, batch = self.mean.shape[0], window.shape[2]
        controls = torch.cat([control_next[None], window[:, n:].flip(0)])
        centre = controls.mean(dim=1)
        relative = window[:, :n].flip(0) - centre[1:, None] - self.mean[:, None]
        amplitudes = torch.tensordot(relative, self.basis, dims=([1, 3], [1, 2]))
        shapes = controls - centre[:, None] - self.shape[:, None]
        path = torch.cat([centre[:1], centre[2:]]) - centre[1]
        regressors = torch.cat(
            [
                amplitudes.transpose(0, 1).reshape(batch, -1),
                shapes.permute(2, 0, 1, 3).reshape(batch, -1),
                path.transpose(0, 1).reshape(batch, -1),
                path.new_ones(batch, 1),
            ],
            dim=1,
        )
        lagged = regressors[:, : self.response.shape[2] - 1]
        first, second = (lagged @ part[:, :-1].T + part[:, -1] for part in self.response)
        softness = (phi[..., :2] * self.placing[:, None]).sum(dim=(0, 2))
        softness = torch.minimum(torch.maximum(softness, self.span[0]), self.span[1])[:, None]
        next_amplitudes = regressors @ self.weight.T + softness * (first + softness * second)
        ahead = torch.tensordot(next_amplitudes, self.basis, dims=1)
        places: Tensor = ahead.transpose(0, 1) + self.mean[:, None] + centre[0]
        return places

    def residual(self, positions: Tensor, phi: Tensor) -> Tensor:
        """What the prior leaves of each step of a track (T, V, 3) with Φ (n, 2): x^{t+1} - x̂^{t+1}, (n, T-1-h, 3)."""
        return one_step_residual(self, positions, phi, self.mean.shape[0], self.history)


def _single(values: Array) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32)
