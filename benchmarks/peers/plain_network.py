"""The network's function written the usual way: edge features concatenated with both ends' states, edge by edge.

It shares a ``WorldModel``'s weights and features, several times slower: the peer of ``benchmarks.speed.world_model``
and, with its gradients and its batches, the oracle of the tests of the split form. Equations and names:
``physworld.worldmodel.model.model``.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from physworld.arrays import Array
from physworld.worldmodel.export import edge_list
from physworld.worldmodel.model.features import edge_features, vertex_features
from physworld.worldmodel.model.graph import EDGE_KINDS
from physworld.worldmodel.model.model import WorldModel


class PlainNetwork(nn.Module):
    """Message passing over an edge list, with nothing taken apart."""

    receiver: Tensor
    sender: Tensor
    kind: Tensor
    rest: Tensor

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        self.model = model
        self._set_edges(edge_list(model.spec))

    def _set_edges(self, edges: dict[str, Array]) -> None:
        for name, key in (("receiver", "receivers"), ("sender", "senders"), ("kind", "kinds")):
            self.register_buffer(name, torch.as_tensor(edges[key]), persistent=False)
        self.register_buffer("rest", torch.as_tensor(edges["rest_relative"]), persistent=False)

    def vertex_features(self, window: Tensor, ahead: Tensor, phi: Tensor) -> Tensor:
        """f_i of every vertex, (V, B, F)."""
        moves = (window[1:] - window[:-1]).flip(0)
        grounded = self.model.spec.ground_height_m is not None
        return vertex_features(window, moves, ahead, phi, self.model.norm, grounded=grounded)

    def edge_features(self, window: Tensor) -> Tensor:
        """e_ij of every edge, (E, B, 3h + 8)."""
        spec = self.model.spec
        relative = window[:, self.sender] - window[:, self.receiver]
        rest = self.rest[:, None].expand(-1, window.shape[2], -1)
        radius = spec.edge_radius_m if spec.current_neighbours else None
        return edge_features(relative, rest, self.kind, self.model.norm, radius)

    def forward(self, window: Tensor, ahead: Tensor, phi: Tensor) -> Tensor:
        """y (n, B, 3); arguments as ``WorldModel.forward``."""
        if self.model.spec.current_neighbours and window.shape[2] > 1:  # every element has edges of its own
            parts = (part.split(1, dim=-2) for part in (window, ahead, phi))
            return torch.cat([self(*element) for element in zip(*parts, strict=True)], dim=1)
        model = self.model
        if model.spec.current_neighbours:
            self._set_edges(edge_list(model.spec, window[-1, :, 0].detach().numpy()))
        features = self.vertex_features(window, ahead, phi)
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
        correction = model.decoder(state[:n]) + model.skip(features[:n])
        return (
            correction if model.modes is None else correction + model.modes(window, ahead) / model.norm.change
        )
