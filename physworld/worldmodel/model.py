"""The graph network: one step of the world model (paper, section GNN-Based World Models).

Legend: n object vertices, C control vertices, V = n + C; D neighbour slots per vertex; H = ``hidden``; h =
``history``; L = ``message_passing_steps``; B batch. Frames are ``dt_s`` apart; positions in metres; the z of a
window counts from the ground where the scene has one. ``relu(x) = max(x, 0)``; a layer ``name`` applies
``x @ name.weight.T + name.bias``. σ_* are the scalars ``norm.*`` below.

**Inputs** at frame t: positions x_i^{t-h} … x_i^t of all vertices, next positions c^{t+1} of the control
vertices, properties φ_i (n, 2) = log(E/E_fit), log(ρ/ρ_fit) of the object vertices.

Vertex features f_i, in this order (no positions: the network is equivariant to translations):
    (x_i^{t-k} - x_i^{t-k-1}) / σ_velocity   for k = 0 … h-1      3h   (each vertex's own velocities, as in GNS;
                                                                       the paper has relative positions only,
                                                                       which hides the fall of a whole body)
    (c_i^{t+1} - c_i^t) / σ_velocity; 0 for object vertices        3   (the action a_t)
    φ_i / σ_properties; 0 for control vertices                     2
    1 if object vertex, 1 if control vertex                        2
    clip(z_i^t / σ_length, 0, 1), only with a ground               1

Edge features e_ij of receiver i and sender j, with r^t = x_j^t - x_i^t and r_rest = ``graph.rest_relative``:
    r^t / σ_length                                                 3
    (r^t - r_rest) / σ_strain                                      3
    ((r^{t-k}) - (r^{t-k-1})) / σ_relative   for k = 0 … h-1      3h
    |r_rest| / σ_length                                            1
    (|r^t| - |r_rest|) / σ_stretch                                 1
    1 if both are object vertices, 1 if one is a control vertex    2

**Equations.** The sums run over the filled slots of ``graph.neighbours[i]``.
    h_i  = encoder.out(relu(encoder.in(f_i)))
    for l = 0 … L-1:
        m_ij = relu(receive.l.weight h_i + send.l.weight h_j + edge.l.weight e_ij + receive.l.bias)
        s_i  = message.l.weight · Σ_j m_ij / norm.degree
        h_i  = h_i + update_out.l(relu(update_in.l.weight [h_i, s_i] + update_in.l.bias))
    y_i  = decoder.out(relu(decoder.in(h_i)))                      (n, 3), object vertices only
    x_i^{t+1} = 2 x_i^t - x_i^{t-1} + σ_acceleration · y_i         a correction of the inertial motion
    x_i^{t+1} = c_i^{t+1}                                          for control vertices

**Tensors** of ``model.safetensors`` (float32 unless said; ``.weight`` is (out, in)):
    encoder.in.weight (H, 3h+7 or 3h+8), encoder.in.bias (H), encoder.out.weight (H, H), encoder.out.bias (H),
    receive.{l}.weight (H, H), receive.{l}.bias (H), send.{l}.weight (H, H), edge.{l}.weight (H, 3h+10),
    message.{l}.weight (H, H), update_in.{l}.weight (H, 2H), update_in.{l}.bias (H), update_out.{l}.weight (H, H),
    update_out.{l}.bias (H), decoder.in.weight (H, H), decoder.in.bias (H), decoder.out.weight (3, H),
    decoder.out.bias (3);
    norm.velocity, norm.relative, norm.strain, norm.stretch, norm.acceleration, norm.length, norm.degree (1,),
    norm.properties (2,);
    graph.neighbours (V, D) int64, V where the slot is empty; graph.rest_relative (V, D, 3).
What ``physworld.worldmodel.files`` adds beside them for a scene is told there.

**Split.** The first edge product of [h_i, h_j, e_ij] is taken apart: h_i and h_j are multiplied once per vertex
and gathered on edges, and so is what of e_ij is linear in positions (r^t = x_j - x_i is a difference of vertex
quantities). Per edge and step there remain a constant of the graph, computed once per sequence, and |r^t|. The
second edge product follows the sum. The function is that of ``naive.NaiveWorldModel`` up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from physworld.worldmodel.config import WorldModelConfig
from physworld.worldmodel.graph import GraphSpec

PROPERTY_COUNT = 2
EMPTY_SLOT = -1.0e9  # added before the ReLU of a message that nobody sends


@dataclass(frozen=True)
class Normalisation:
    """Root-mean-square scales of the training data, in metres (``properties``: of the logarithms).

    Attributes:
        velocity: of vertex displacements per step.
        relative: of relative displacements per step along edges.
        strain: of r - r_rest along edges.
        stretch: of |r| - |r_rest| along edges.
        acceleration: of x^{t+1} - 2 x^t + x^{t-1}.
        properties: of Φ, (2,).
    """

    velocity: float = 1.0
    relative: float = 1.0
    strain: float = 1.0
    stretch: float = 1.0
    acceleration: float = 1.0
    properties: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True)
class EdgeConstants:
    """Per-layer edge terms that depend on weights and graph only: ``bias`` (L, V, D, 1, H), ``position`` (L,
    3(h+1), H) for the linear part of the positions, ``length`` (L, H) for |r^t|."""

    bias: Tensor
    position: Tensor
    length: Tensor


class WorldModel(nn.Module):
    """Encode, process, decode: the correction of every object vertex's inertial motion over one step."""

    def __init__(
        self, config: WorldModelConfig, spec: GraphSpec, normalisation: Normalisation | None = None
    ) -> None:
        super().__init__()
        self.config = config
        self.spec = spec
        hidden, h, layers = config.hidden, config.history, config.message_passing_steps
        vertex_features = 3 * h + 5 + PROPERTY_COUNT + (spec.ground_height_m is not None)
        self.encoder = _two_layers(vertex_features, hidden, hidden)
        self.receive = nn.ModuleList(nn.Linear(hidden, hidden) for _ in range(layers))
        self.send = nn.ModuleList(nn.Linear(hidden, hidden, bias=False) for _ in range(layers))
        self.edge = nn.ModuleList(nn.Linear(3 * h + 10, hidden, bias=False) for _ in range(layers))
        self.message = nn.ModuleList(nn.Linear(hidden, hidden, bias=False) for _ in range(layers))
        self.update_in = nn.ModuleList(nn.Linear(2 * hidden, hidden) for _ in range(layers))
        self.update_out = nn.ModuleList(nn.Linear(hidden, hidden) for _ in range(layers))
        self.decoder = _two_layers(hidden, hidden, 3)
        self._set_graph(spec)
        self.norm = _Scales(normalisation or Normalisation(), spec, config)

    def _set_graph(self, spec: GraphSpec) -> None:
        vertex_count, n = spec.vertex_count, spec.object_count
        filled = spec.neighbours < vertex_count
        receiver = np.broadcast_to(np.arange(vertex_count)[:, None], spec.neighbours.shape)
        own = np.where(filled, spec.neighbours, receiver)
        rest_length = np.linalg.norm(spec.rest_relative, axis=2)
        controlled = (own >= n) | (receiver >= n)
        reference = _reference_positions(spec)
        offset = reference[own] - reference[receiver]
        buffers = {
            "_senders": torch.as_tensor(spec.neighbours.reshape(-1), dtype=torch.int64),
            "_senders_or_self": torch.as_tensor(own.reshape(-1), dtype=torch.int64),
            "_reference": torch.as_tensor(reference, dtype=torch.float32),
            "_offset": torch.as_tensor(offset, dtype=torch.float32),
            "_excess": torch.as_tensor(offset - spec.rest_relative, dtype=torch.float32),
            "_rest_length": torch.as_tensor(rest_length, dtype=torch.float32),
            "_kind": torch.as_tensor(np.stack([~controlled, controlled], axis=2), dtype=torch.float32),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)

    def forward(
        self, window: Tensor, action: Tensor, phi: Tensor, constants: EdgeConstants | None = None
    ) -> Tensor:
        """Normalised accelerations (n, B, 3).

        Args:
            window: x^{t-h} … x^t [m], (h+1, V, B, 3).
            action: c^{t+1} - c^t [m], (C, B, 3).
            phi: log property ratios of the object vertices, (n, B, 2).
            constants: ``edge_constants()``, when many steps share the weights.
        """
        constants = constants or self.edge_constants()
        n, slots = self.spec.object_count, self.spec.neighbours.shape[1]
        vertex_count, batch, hidden = window.shape[1], window.shape[2], self.config.hidden
        moves = (window[1:] - window[:-1]).flip(0)
        state = self.encoder(self._vertex_features(window, moves, action, phi))
        shifted = window[-1] - self._reference[:, None]
        places = torch.cat([shifted, *moves.unbind(0)], dim=-1)
        relative = shifted.index_select(0, self._senders_or_self).view(vertex_count, slots, batch, 3)
        relative = relative - shifted[:, None] + self._offset[:, :, None]
        length = torch.linalg.vector_norm(relative, dim=-1, keepdim=True)
        silent = torch.full((1, batch, hidden), EMPTY_SLOT, dtype=state.dtype, device=state.device)
        for layer in range(self.config.message_passing_steps):
            placed = places @ constants.position[layer]
            heard = self.receive[layer](state) - placed
            sent = torch.cat([self.send[layer](state) + placed, silent])
            edges = sent.index_select(0, self._senders).view(vertex_count, slots, batch, hidden)
            edges = edges + constants.bias[layer]
            edges = torch.addcmul(edges, length, constants.length[layer])
            received = torch.relu(edges + heard[:, None]).sum(dim=1) / self.norm.degree
            own, other = self.update_in[layer].weight.split(hidden, dim=1)
            inner = state @ own.T + received @ (other @ self.message[layer].weight).T
            state = state + self.update_out[layer](torch.relu(inner + self.update_in[layer].bias))
        return self.decoder(state[:n])

    def step(
        self, window: Tensor, control_next: Tensor, phi: Tensor, constants: EdgeConstants | None = None
    ) -> Tensor:
        """Positions of all vertices at t + 1 [m], (V, B, 3); control vertices go to ``control_next`` (C, B, 3)."""
        n = self.spec.object_count
        correction = self.forward(window, control_next - window[-1, n:], phi, constants)
        inertial = 2.0 * window[-1, :n] - window[-2, :n]
        return torch.cat([inertial + self.norm.acceleration * correction, control_next])

    def edge_constants(self) -> EdgeConstants:
        """What of the edge products depends on weights and graph only; valid until the weights change."""
        h = self.config.history
        weights = torch.stack([layer.weight.T for layer in self.edge])
        near, strain = weights[:, 0:3] / self.norm.length, weights[:, 3:6] / self.norm.strain
        moves = weights[:, 6 : 6 + 3 * h] / self.norm.relative
        rest, stretch = weights[:, 6 + 3 * h], weights[:, 7 + 3 * h] / self.norm.stretch
        kind = weights[:, 8 + 3 * h :]
        bias = torch.einsum("vdx,lxh->lvdh", self._offset, near)
        bias = bias + torch.einsum("vdx,lxh->lvdh", self._excess, strain)
        bias = bias + torch.einsum("vdx,lxh->lvdh", self._kind, kind)
        bias = bias + self._rest_length[..., None] * (rest / self.norm.length - stretch)[:, None, None]
        return EdgeConstants(bias[:, :, :, None], torch.cat([near + strain, moves], dim=1), stretch)

    def _vertex_features(self, window: Tensor, moves: Tensor, action: Tensor, phi: Tensor) -> Tensor:
        """f_i, (V, B, F)."""
        n, control, batch = self.spec.object_count, self.spec.control_count, window.shape[2]
        new = window.new_zeros
        own = moves.permute(1, 2, 0, 3).flatten(2) / self.norm.velocity
        act = torch.cat([new(n, batch, 3), action / self.norm.velocity])
        properties = torch.cat([phi / self.norm.properties, new(control, batch, PROPERTY_COUNT)])
        kind = new(n + control, batch, 2)
        kind[:n, :, 0] = 1.0
        kind[n:, :, 1] = 1.0
        parts = [own, act, properties, kind]
        if self.spec.ground_height_m is not None:
            parts.append(torch.clamp(window[-1, :, :, 2:] / self.norm.length, 0.0, 1.0))
        return torch.cat(parts, dim=-1)


class _Scales(nn.Module):
    """The scalars ``norm.*`` as float32 buffers of shape (1,), ``properties`` (2,)."""

    def __init__(self, normalisation: Normalisation, spec: GraphSpec, config: WorldModelConfig) -> None:
        super().__init__()
        values = {name: getattr(normalisation, name) for name in ("velocity", "relative", "strain", "stretch")}
        values |= {"acceleration": normalisation.acceleration, "length": spec.edge_radius_m}
        values["degree"] = float(config.neighbours)
        for name, value in values.items():
            self.register_buffer(name, torch.tensor([value], dtype=torch.float32))
        self.register_buffer("properties", torch.tensor(normalisation.properties, dtype=torch.float32))


def _two_layers(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """``in`` → ReLU → ``out``."""
    layers = nn.Sequential()
    layers.add_module("in", nn.Linear(inputs, hidden))
    layers.add_module("relu", nn.ReLU())
    layers.add_module("out", nn.Linear(hidden, outputs))
    return layers


def _reference_positions(spec: GraphSpec) -> np.ndarray:
    """A place of every vertex from which displacements are counted, (V, 3): rest, and near it for controllers."""
    n = spec.object_count
    reference = np.concatenate([spec.rest_vertices, np.zeros((spec.control_count, 3))])
    for vertex in range(n, spec.vertex_count):
        reference[vertex] = reference[spec.neighbours[vertex, 0]] - spec.rest_relative[vertex, 0]
    return reference - reference[:n].mean(axis=0)
