"""The same network written the usual way: edge features concatenated with both ends' states, edge by edge.

It shares a ``WorldModel``'s weights. It is the oracle of the tests and the yardstick of the benchmark, not
meant to be used: it is several times slower. Equations and names: ``physworld.worldmodel.model.model``.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from physworld.arrays import Array
from physworld.worldmodel.export import edge_list
from physworld.worldmodel.model.graph import EDGE_KINDS, NEAR
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.nearest import cut_rest_length, cut_strain


class NaiveWorldModel(nn.Module):
    """Message passing over an edge list, with nothing taken apart."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        self.model = model
        self._set_edges(edge_list(model.spec))

    def _set_edges(self, edges: dict[str, Array]) -> None:
        for name, key in (("receiver", "receivers"), ("sender", "senders"), ("kind", "kinds")):
            self.register_buffer(name, torch.as_tensor(edges[key]), persistent=False)
        self.register_buffer("rest", torch.as_tensor(edges["rest_relative"]), persistent=False)

    def edge_features(self, window: Tensor) -> Tensor:
        """e_ij of every edge, (E, B, 3h + 8)."""
        norm = self.model.norm
        batch = window.shape[2]
        relative = window[:, self.sender] - window[:, self.receiver]
        rest = self.rest[:, None].expand(-1, batch, -1)
        rest_length = torch.linalg.vector_norm(rest, dim=-1, keepdim=True)
        strained = relative[-1] - rest
        if self.model.spec.current_neighbours:
            near, radius = (self.kind == NEAR)[:, None, None], self.model.spec.edge_radius_m
            strained = torch.where(near, cut_strain(strained, radius), strained)
            rest_length = torch.where(near, cut_rest_length(rest_length, radius), rest_length)
        length = torch.linalg.vector_norm(relative[-1], dim=-1, keepdim=True)
        strain, drift, stretch = (
            scale[self.kind][:, None, None] for scale in (norm.strain, norm.relative, norm.stretch)
        )
        moves = (relative[1:] - relative[:-1]).flip(0) / drift
        return torch.cat(
            [
                relative[-1] / norm.length,
                strained / strain,
                *moves.unbind(0),
                rest_length / norm.length,
                (length - rest_length) / stretch,
            ],
            dim=-1,
        )

    def forward(self, window: Tensor, ahead: Tensor, phi: Tensor) -> Tensor:
        """y (n, B, 3); arguments as ``WorldModel.forward``."""
        if self.model.spec.current_neighbours and window.shape[2] > 1:  # every element has edges of its own
            parts = (part.split(1, dim=-2) for part in (window, ahead, phi))
            return torch.cat([self(*element) for element in zip(*parts, strict=True)], dim=1)
        model = self.model
        if model.spec.current_neighbours:
            self._set_edges(edge_list(model.spec, window[-1, :, 0].detach().numpy()))
        moves = (window[1:] - window[:-1]).flip(0)
        features = model._vertex_features(window, moves, ahead, phi)
        state = model.encoder(features)
        edges = self.edge_features(window)
        kinds = [torch.nonzero(self.kind == k)[:, 0] for k in range(EDGE_KINDS)]
        for layer in range(model.config.message_passing_steps):
            ends = torch.cat([model.receive[layer].weight, model.send[layer].weight], dim=1)
            own, *others = model.update_in[layer].weight.chunk(1 + EDGE_KINDS, dim=1)
            inner = state @ own.T + model.update_in[layer].bias
            for kind, taken in enumerate(kinds):
                receiver = self.receiver[taken]
                joined = torch.cat([state[receiver], state[self.sender[taken]], edges[taken]], dim=-1)
                weight = torch.cat([ends, model.edge[layer].weight[kind]], dim=1)
                messages = torch.relu(joined @ weight.T + model.receive[layer].bias) @ others[kind].T
                degree = torch.bincount(receiver, minlength=state.shape[0]).clamp(min=1)
                inner = (
                    inner + torch.zeros_like(state).index_add(0, receiver, messages) / degree[:, None, None]
                )
            state = state + model.update_out[layer](torch.relu(inner))
        n = model.spec.object_count
        return model.decoder(state[:n]) + model.skip(features[:n])
