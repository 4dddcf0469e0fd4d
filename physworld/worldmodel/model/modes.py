"""A linear map of the body's modes beside the messages, where no modal prior is under the network.

Messages tell a vertex what is near it, and no places: how fast a whole rope swings, or how its hands drive its shape,
they do not see. Legend as in ``physworld.worldmodel.model.model``; U (R, n): lowest eigenvectors of the Laplacian of
the graph at rest, mean square 1; c̄^t: mean of the control vertices at t; ⟨v⟩_r = Σ_i U_ri v_i / n.

    p   = x^t - c̄^t,   x^t - x^{t-1},   x^{t-k} - 2 x^{t-k-1} + x^{t-k-2} for k = 0 … h-2,   x̂^{t+1} - x^t       (h+2)
    q   = c^t - c̄^t,   c^{t+1-k} - c^{t-k} for k = 0 … h                                                          (h+2)
    s   = (⟨p⟩_r of each p, and each q; 3 (h+2) (R + C) numbers - modes.middle) / modes.scale,   cut to ±BOUND
    x_i^{t+1} += Σ_r U_ri modes.change_r Σ_f s_f modes.weight_fr

``middle`` and ``scale`` are means and sizes in the episodes. Cut to a few times these, what the map adds is bounded: on
the sample rope an unbounded one diverges in one of eight unseen motions, the bounded one in none
(``docs/world_model_study.md``).

Tensors: modes.shapes U (R, n); modes.middle, modes.scale (F,) [m]; modes.change (R,) [m]; modes.weight (F, 3R), the row
of each s; in such a version ``skip.weight`` is named ``skip.beside_modes.weight``, so that a reader that does not know
of the map finds none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from physworld.arrays import Array
from physworld.worldmodel.model.frame import enter
from physworld.worldmodel.model.graph import GraphSpec

MODES = 16
BOUND = 3.0
KERNEL_SPACINGS = 1.5  # width of the weights of the Laplacian, in mean distances of nearest vertices
SMALLEST_M = 1e-8
LEAST_SHARE = 0.01  # of how far the body's modes move in a tick: what varies less is not told more finely
MEASURED = 24  # tracks that the sizes are measured on


@dataclass(frozen=True)
class ModeScales:
    """``shapes`` (R, n), ``middle`` and ``scale`` (F,) [m], ``change`` (R,) [m]: the tensors of the module's text."""

    shapes: Array
    middle: Array
    scale: Array
    change: Array


class ModalMap(nn.Module):
    """The map, 0 at first."""

    shapes: Tensor
    middle: Tensor
    scale: Tensor
    change: Tensor

    def __init__(self, scales: ModeScales) -> None:
        super().__init__()
        for name, value in vars(scales).items():
            self.register_buffer(name, torch.as_tensor(np.asarray(value, dtype=np.float32)))
        self.weight = nn.Parameter(torch.zeros(len(scales.middle), 3 * len(scales.shapes)))

    def forward(self, window: Tensor, ahead: Tensor) -> Tensor:
        """What is added to the object vertices [m], (n, B, 3).

        Args:
            window: x^{t-h} … x^t [m], (h+1, V, B, 3).
            ahead: x̂^{t+1} of the object vertices and c^{t+1} [m], (V, B, 3).
        """
        seen = (modal_features(self.shapes, window, ahead) - self.middle) / self.scale
        moved = seen.clamp(-BOUND, BOUND) @ self.weight
        moved = moved.reshape(-1, self.change.shape[0], 3) * self.change[:, None]
        return torch.einsum("rn,brk->nbk", self.shapes, moved)


def modal_features(shapes: Tensor, window: Tensor, ahead: Tensor) -> Tensor:
    """⟨p⟩ and q of the module's text [m], (B, F); arguments as of :class:`ModalMap`, ``shapes`` (R, n)."""
    n = shapes.shape[1]
    middle = window[-1, n:].mean(dim=0)
    moves = (window[1:] - window[:-1]).flip(0)
    own = [
        window[-1, :n] - middle,
        moves[0, :n],
        *(moves[:-1, :n] - moves[1:, :n]),
        ahead[:n] - window[-1, :n],
    ]
    held = [window[-1, n:] - middle, ahead[n:] - window[-1, n:], *moves[:, n:]]
    of_modes = torch.einsum("rn,pnbk->bprk", shapes, torch.stack(own)) / n
    return torch.cat([of_modes.flatten(1), torch.stack(held).permute(2, 0, 1, 3).flatten(1)], dim=1)


def graph_modes(rest: Array, count: int = MODES) -> Array:
    """U (R, n) of rest places (n, 3) [m]; at most n modes."""
    apart = np.linalg.norm(rest[:, None] - rest[None], axis=2)
    width = KERNEL_SPACINGS * np.sort(apart, axis=1)[:, 1].mean()
    weights = np.exp(-0.5 * np.square(apart / width))
    np.fill_diagonal(weights, 0.0)
    modes = np.linalg.eigh(np.diag(weights.sum(axis=1)) - weights)[1]
    shapes: Array = np.ascontiguousarray(modes[:, :count].T * np.sqrt(len(rest)))
    return shapes


def measure_modes(paths: Sequence[Tensor], spec: GraphSpec, history: int) -> ModeScales:
    """Shapes and sizes from the steps of the first ``MEASURED`` paths (T, V, 3) [m].

    x̂ is taken to be x^t + (x^t - x^{t-1}): its size is that of a step, whatever the prior.
    """
    n, shapes = spec.object_count, graph_modes(spec.rest_vertices)
    turned = torch.as_tensor(shapes, dtype=torch.float32)
    features, changes = [], []
    for path in paths[:MEASURED]:
        steps = len(path) - 1 - history
        window = torch.stack([path[k : k + steps].transpose(0, 1) for k in range(history + 1)])
        following = path[history + 1 :, n:].transpose(0, 1)
        if spec.frame is not None:
            _, window, following = enter(spec.frame, window, following)
        ahead = torch.cat([2.0 * window[-1, :n] - window[-2, :n], following])
        features.append(modal_features(turned, window, ahead))
        change = path[2:, :n] - 2.0 * path[1:-1, :n] + path[:-2, :n]
        changes.append(torch.einsum("rn,tnk->trk", turned, change) / n)
    seen = torch.cat(features).double()
    parts, modes, controls = history + 2, len(shapes), spec.control_count
    of_modes, of_held = seen[:, : 3 * parts * modes], seen[:, 3 * parts * modes :]
    own, held = of_modes.reshape(-1, parts, modes, 3), of_held.reshape(-1, parts, controls, 3)
    middles = []
    for values in (own, held):
        middle = torch.zeros_like(values[0])
        middle[0] = values[:, 0].mean(dim=0)
        middles.append(middle)
    of_own = (own - middles[0]).square().mean(dim=(0, 3)).sqrt()
    of_held = (held - middles[1]).square().mean(dim=(0, 2, 3)).sqrt()
    least = max(SMALLEST_M, LEAST_SHARE * float(of_own[1].max()))
    sizes = [of_own[..., None].expand_as(own[0]), of_held[:, None, None].expand_as(held[0])]
    return ModeScales(
        shapes=shapes,
        middle=torch.cat([middle.flatten() for middle in middles]).numpy(),
        scale=torch.cat([size.flatten() for size in sizes]).clamp(min=least).numpy(),
        change=torch.cat(changes).square().mean(dim=(0, 2)).sqrt().clamp(min=SMALLEST_M).numpy(),
    )
