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
from physworld.worldmodel.messages import EdgeList, sum_messages

PROPERTY_COUNT = 2


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
    """Per-layer edge terms that depend on weights and graph only: ``bias`` (E, H), ``position`` (3(h+1), H) for the
    linear part of the positions, ``length`` (H,) for |r^t|."""

    bias: tuple[Tensor, ...]
    position: tuple[Tensor, ...]
    length: tuple[Tensor, ...]


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
        """Constants of the edges, in the order of the edge list."""
        n = spec.object_count
        self.edges = EdgeList.from_neighbours(spec.neighbours)
        filled = spec.neighbours < spec.vertex_count
        receivers, senders = np.nonzero(filled)[0], spec.neighbours[filled]
        reference, rest = _reference_positions(spec), spec.rest_relative[filled]
        controlled = (senders >= n) | (receivers >= n)
        offset = reference[senders] - reference[receivers]
        buffers = {
            "_reference": reference,
            "_offset": offset,
            "_constants": np.column_stack(
                [offset, offset - rest, np.linalg.norm(rest, axis=1), ~controlled, controlled]
            ),
        }
        for name, value in buffers.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)
        self.register_buffer("_senders", torch.as_tensor(senders, dtype=torch.int64), persistent=False)

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
        n, hidden = self.spec.object_count, self.config.hidden
        moves = (window[1:] - window[:-1]).flip(0)
        state = self.encoder(self._vertex_features(window, moves, action, phi))
        shifted = window[-1] - self._reference[:, None]
        places = torch.cat([shifted, *moves.unbind(0)], dim=-1)
        relative = shifted.index_select(0, self._senders) - shifted.index_select(0, self.edges.receivers)
        length = torch.linalg.vector_norm(relative + self._offset[:, None], dim=-1)
        for layer in range(self.config.message_passing_steps):
            placed = places @ constants.position[layer]
            heard = self.receive[layer](state) - placed
            sent = self.send[layer](state) + placed
            received = sum_messages(
                self.edges, heard, sent, constants.bias[layer], length, constants.length[layer]
            )
            own, other = self.update_in[layer].weight.split(hidden, dim=1)
            other = other @ self.message[layer].weight / self.norm.degree
            inner = state @ own.T + received @ other.T + self.update_in[layer].bias
            state = state + self.update_out[layer](torch.relu(inner))
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
        h, norm = self.config.history, self.norm
        bias, position, length = [], [], []
        for layer in self.edge:
            weight = layer.weight.T
            near, strain = weight[0:3] / norm.length, weight[3:6] / norm.strain
            moves, rest = weight[6 : 6 + 3 * h] / norm.relative, weight[6 + 3 * h] / norm.length
            stretch, kind = weight[7 + 3 * h] / norm.stretch, weight[8 + 3 * h :]
            bias.append(self._constants @ torch.cat([near, strain, (rest - stretch)[None], kind]))
            position.append(torch.cat([near + strain, moves]))
            length.append(stretch)
        return EdgeConstants(tuple(bias), tuple(position), tuple(length))

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
