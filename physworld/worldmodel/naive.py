"""The same network written the usual way: edge features concatenated with both ends' states, edge by edge.

It shares a ``WorldModel``'s weights. It is the oracle of the tests and the yardstick of the benchmark, not meant
to be used: it is several times slower. Equations and names: ``physworld.worldmodel.model``.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from physworld.worldmodel.model import WorldModel


class NaiveWorldModel(nn.Module):
    """Message passing over an edge list, with nothing taken apart."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        self.model = model
        spec = model.spec
        neighbours = torch.as_tensor(spec.neighbours)
        receiver, slot = torch.nonzero(neighbours < spec.vertex_count, as_tuple=True)
        self.register_buffer("receiver", receiver, persistent=False)
        self.register_buffer("sender", neighbours[receiver, slot], persistent=False)
        rest = torch.as_tensor(spec.rest_relative, dtype=torch.float32)[receiver, slot]
        self.register_buffer("rest", rest, persistent=False)
        controlled = (self.receiver >= spec.object_count) | (self.sender >= spec.object_count)
        self.register_buffer("kind", torch.stack([~controlled, controlled], 1).float(), persistent=False)

    def edge_features(self, window: Tensor) -> Tensor:
        """e_ij of every edge, (E, B, 3h + 10)."""
        norm = self.model.norm
        batch = window.shape[2]
        relative = window[:, self.sender] - window[:, self.receiver]
        rest = self.rest[:, None].expand(-1, batch, -1)
        rest_length = torch.linalg.vector_norm(rest, dim=-1, keepdim=True)
        length = torch.linalg.vector_norm(relative[-1], dim=-1, keepdim=True)
        moves = (relative[1:] - relative[:-1]).flip(0) / norm.relative
        return torch.cat(
            [
                relative[-1] / norm.length,
                (relative[-1] - rest) / norm.strain,
                *moves.unbind(0),
                rest_length / norm.length,
                (length - rest_length) / norm.stretch,
                self.kind[:, None].expand(-1, batch, -1),
            ],
            dim=-1,
        )

    def forward(self, window: Tensor, action: Tensor, phi: Tensor) -> Tensor:
        """Normalised accelerations (n, B, 3); arguments as ``WorldModel.forward``."""
        model = self.model
        moves = (window[1:] - window[:-1]).flip(0)
        state = model.encoder(model._vertex_features(window, moves, action, phi))
        edges = self.edge_features(window)
        for layer in range(model.config.message_passing_steps):
            weight = torch.cat(
                [model.receive[layer].weight, model.send[layer].weight, model.edge[layer].weight], dim=1
            )
            joined = torch.cat([state[self.receiver], state[self.sender], edges], dim=-1)
            messages = torch.relu(joined @ weight.T + model.receive[layer].bias)
            messages = messages @ model.message[layer].weight.T
            total = torch.zeros_like(state).index_add(0, self.receiver, messages) / model.norm.degree
            inner = model.update_in[layer](torch.cat([state, total], dim=-1))
            state = state + model.update_out[layer](torch.relu(inner))
        return model.decoder(state[: model.spec.object_count])
