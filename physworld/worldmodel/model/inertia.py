"""No prior: the network alone moves the vertices; x̂ is where they would be if they kept their velocity.

    x̂_i^{t+1} = 2 x_i^t - x_i^{t-1}

The network then predicts the acceleration of every vertex, as in GNS (Sanchez-Gonzalez et al. 2020); the paper's
predicts the displacement from the same history. Tensor: prior.lags (2,), the weights of x^t and x^{t-1}.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class InertialPrior:
    """Nothing is fitted; ``objects``: n."""

    objects: int


class InertialStep(nn.Module):
    """x̂^{t+1} of the object vertices."""

    lags: Tensor

    def __init__(self, prior: InertialPrior, history: int) -> None:
        super().__init__()
        self.objects, self.history = prior.objects, history
        self.register_buffer("lags", torch.tensor([2.0, -1.0]))

    def forward(self, window: Tensor, control_next: Tensor, phi: Tensor) -> Tensor:
        """x̂^{t+1} (n, B, 3) from x^{t-h} … x^t (h+1, V, B, 3)."""
        now, before = window[-1, : self.objects], window[-2, : self.objects]
        return self.lags[0] * now + self.lags[1] * before

    def residual(self, positions: Tensor, phi: Tensor) -> Tensor:
        """What is left of each step of a track (T, V, 3): x^{t+1} - x̂^{t+1}, (n, T-1-h, 3)."""
        return one_step_residual(self, positions, phi, self.objects, self.history)


def one_step_residual(
    step: Callable[[Tensor, Tensor, Tensor], Tensor], positions: Tensor, phi: Tensor, n: int, history: int
) -> Tensor:
    """What a prior leaves of each step of a track: (n, T-1-h, 3) [m].

    Args:
        step: the prior: (window, control vertices, Φ) to object vertices at t + 1.
        positions: of all vertices (T, V, 3) [m].
        phi: logarithms of property ratios (n, ·).
        n: object vertices.
        history: h.
    """
    count = positions.shape[0] - 1 - history
    window = torch.stack([positions[k : k + count].transpose(0, 1) for k in range(history + 1)])
    following = positions[history + 1 :].transpose(0, 1)
    return following[:n] - step(window, following[n:], phi[:, None].expand(-1, count, -1))
