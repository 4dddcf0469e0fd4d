"""The graph network: one step of the world model (paper, section GNN-Based World Models).

Legend: n object vertices, C control vertices, V = n + C; D neighbour slots per vertex; H = ``hidden``; h =
``history``; L = ``message_passing_steps``; B batch. Frames are ``dt_s`` apart; positions in metres; the z
of a window counts from the ground where the scene has one. ``relu(x) = max(x, 0)``; a layer ``name``
applies ``x @ name.weight.T + name.bias``. σ_* are the scalars ``norm.*`` below.

**Inputs** at frame t: positions x_i^{t-h} … x_i^t of all vertices, next positions c^{t+1} of the control
vertices, properties φ_i (n, 2) = log(E/E_fit), log(ρ/ρ_fit) of the object vertices.

Vertex features f_i, in this order (no positions: the network is equivariant to translations):
    (x_i^{t-k} - x_i^{t-k-1}) / σ_velocity   for k = 0 … h-1      3h   (own velocities, as in GNS: relative
                                                                        positions hide a whole body's fall)
    (x̂_i^{t+1} - x_i^t) / σ_velocity, for control vertices
        (c_i^{t+1} - c_i^t) / σ_velocity                           3   (the prior; the action a_t)
    φ_i / σ_properties; 0 for control vertices                     2
    1 if object vertex, 1 if control vertex                        2
    clip(z_i^t / σ_length, 0, 1), only with a ground               1

Edge features e_ij of receiver i and sender j, with r^t = x_j^t - x_i^t and r_rest =
``graph.rest_relative``; κ = ``graph.edge_kind`` is 0 near, 1 coarse (both between object vertices), 2 grip
(with a control vertex):
    r^t / σ_length                                                 3
    (r^t - r_rest) / σ_strain[κ]                                   3
    ((r^{t-k}) - (r^{t-k-1})) / σ_relative[κ]   for k = 0 … h-1   3h
    |r_rest| / σ_length                                            1
    (|r^t| - |r_rest|) / σ_stretch[κ]                              1
The type of an edge is not a feature: each kind has weights of its own.

**Equations.** Means run over the filled slots of kind κ of ``graph.neighbours[i]``; 0 where there is none.
    h_i  = encoder.out(relu(encoder.in(f_i)))
    for l = 0 … L-1:
        m_ij = relu(receive.l.weight h_i + send.l.weight h_j + edge.l.weight[κ_ij] e_ij + receive.l.bias)
        s_iκ = mean_{j of kind κ} m_ij                             κ = 0, 1, 2
        h_i  = h_i + update_out.l(relu(update_in.l.weight [h_i, s_i0, s_i1, s_i2] + update_in.l.bias))
    y_i  = decoder.out(relu(decoder.in(h_i))) + skip.weight f_i     (n, 3), object vertices only
    x_i^{t+1} = x̂_i^{t+1} + σ_change · y_i                         x̂: the prior, modal or chain
    x_i^{t+1} = c_i^{t+1}                                          for control vertices

**Modal prior** (``physworld.worldmodel.priors.modal`` says why). c̄^s: mean of the control vertices at frame s,
where s = t+1 takes c^{t+1}.
    a^s = Σ_i prior.basis[:, i] · (x_i^s - c̄^s - prior.mean_i)     (R,), s = t … t-h
    d^s = c^s - c̄^s - prior.shape                                  (C, 3), s = t+1, t … t-h
    e^s = c̄^s - c̄^t                                                (3,), s = t+1, t-1 … t-h
    a^{t+1} = prior.weight [a^t … a^{t-h}, d^{t+1}, d^t … d^{t-h}, e^{t+1}, e^{t-1} … e^{t-h}, 1]
            + ζ prior.response[0] [a^t … a^{t-h}, 1] + ζ² prior.response[1] [a^t … a^{t-h}, 1]
    ζ = Σ_i prior.placing_i · φ_i, cut to prior.span
    x̂_i^{t+1} = c̄^{t+1} + prior.mean_i + Σ_r a_r^{t+1} prior.basis[r, i]

**Chain prior**, of ropes, in place of the modal one: ``physworld.worldmodel.priors.chain`` has its equations; its
tensors are ``prior.`` and the fields of ``ChainPrior``, float32, and prior.substeps (1,) int64. Where prior.natural is
not 0, prior.curve is named prior.coiled_curve.

**No prior**: ``physworld.worldmodel.model.inertia``; prior.lags (2,) in place of the modal prior's tensors.

**Beside a chain and without a prior** a linear map of the body's modes is added to x_i^{t+1}:
``physworld.worldmodel.model.modes`` has its equations and tensors.

**In the grip's frame**, where ``graph.frame_shape`` is among the tensors: all of the above holds for y in place of x
(``physworld.worldmodel.model.frame``). The edges then stand in ``graph.turned_neighbours``, of the shape and meaning of
``graph.neighbours``, which such a model lacks.

**NEAR edges of the current shape**, where ``graph.current_neighbours`` (1,) int64 is among the tensors:
``physworld.worldmodel.model.nearest`` says which they are and what is cut off their features. The others then stand in
``graph.kept_neighbours``, of the shape and meaning of ``graph.neighbours``, which such a model lacks.

**Tensors** of ``model.safetensors`` (float32 unless said; ``.weight`` is (out, in)):
    encoder.in.weight (H, 3h+7 or 3h+8), encoder.in.bias (H), encoder.out.weight (H, H), encoder.out.bias (H),
    receive.{l}.weight (H, H), receive.{l}.bias (H), send.{l}.weight (H, H), edge.{l}.weight (3, H, 3h+8),
    update_in.{l}.weight (H, 4H), update_in.{l}.bias (H), update_out.{l}.weight (H, H),
    update_out.{l}.bias (H), decoder.in.weight (H, H), decoder.in.bias (H), decoder.out.weight (3, H),
    decoder.out.bias (3), skip.weight (3, 3h+7 or 3h+8);
    norm.velocity, norm.change, norm.length (1,), norm.relative, norm.strain, norm.stretch (3,),
    norm.properties (2,);
    prior.mean (n, 3), prior.basis (R, n, 3), prior.shape (C, 3), prior.weight (R, F) with
    F = (h+1) R + (h+2) 3C + (h+1) 3 + 1, prior.response (2, R, (h+1) R + 1), prior.placing (n, 2), prior.span (2,);
    graph.neighbours (V, D) int64, V where the slot is empty; graph.edge_kind (V, D) int64;
    graph.rest_relative (V, D, 3).

**Strengths.** Where episodes differ in the strengths of effects as well, Φ has m more columns while the network learns
and is fine-tuned: each strength's distance from its estimate in half-widths of its interval, the same at every object
vertex. The ground's friction is such a column too, log(μ/μ_fit), in the episodes a field over the object; fine-tuning
sets it by one number, since a recording hardly shows where the object rubs. A published version stands at fixed
strengths: what they add to the first layers is constant over the object's vertices and goes into the weight of its kind
(:meth:`WorldModel.at_strengths`), so that all of the above stays as it is.

What a published version adds for its scene is told in ``physworld.worldmodel.published``.

**Split.** The first edge product of [h_i, h_j, e_ij] is taken apart: h_i and h_j are multiplied once per
vertex and gathered on edges, and so is what of e_ij is linear in positions (r^t = x_j - x_i is a difference
of vertex quantities). Per edge and step there remain a constant of the graph, computed once per sequence,
and |r^t|. The product of the messages with update_in follows the sum. The function is that of the
exported step (``physworld.worldmodel.export``) up to rounding.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from physworld.arrays import Array
from physworld.worldmodel.errors import NetworkMismatch
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.features import Normalisation, Scales, vertex_features
from physworld.worldmodel.model.frame import Turn, enter, leave
from physworld.worldmodel.model.graph import EDGE_KINDS, NEAR, GraphSpec
from physworld.worldmodel.model.inertia import InertialPrior
from physworld.worldmodel.model.modes import ModalMap, ModeScales
from physworld.worldmodel.model.nearest import CurrentEdges, KeptEdges
from physworld.worldmodel.model.properties import PROPERTIES, PhiColumn
from physworld.worldmodel.native.messages import EdgeList, as_seen, mean_messages
from physworld.worldmodel.priors.chain import ChainPrior
from physworld.worldmodel.priors.modal import ModalPrior, rigid_prior
from physworld.worldmodel.priors.prior_step import framed_prior, prior_step

Means = Callable[[int, Tensor, Tensor], Tensor]
"""Mean messages (K, V, B, H) of a layer from what is heard and sent (K, V, B, H)."""


@dataclass(frozen=True)
class EdgeConstants:
    """Edge terms by layer that depend on weights and graph only: ``bias`` (E, H), ``position`` (3, 3(h+1), H) for
    the linear part of the positions, ``length`` (3, H) for |r^t|, ``near`` (7, H) for what NEAR edges keep: r_rest,
    what is cut off their strain, and |r_rest|."""

    bias: tuple[Tensor, ...]
    position: tuple[Tensor, ...]
    length: tuple[Tensor, ...]
    near: tuple[Tensor, ...]


class WorldModel(nn.Module):
    """Encode, process, decode: what every object vertex does in one step beyond the prior."""

    _reference: Tensor
    _offset: Tensor
    _constants: Tensor
    _share: Tensor
    _senders: Tensor
    _receivers: Tensor

    def __init__(
        self,
        config: WorldModelConfig,
        spec: GraphSpec,
        normalisation: Normalisation | None = None,
        prior: ModalPrior | ChainPrior | InertialPrior | None = None,
        columns: tuple[PhiColumn, ...] = PROPERTIES,
        modes: ModeScales | None = None,
    ) -> None:
        """Random weights, whose output is 0.

        Args:
            config: widths and numbers of layers.
            spec: the graph.
            normalisation: scales of the data; 1 without them.
            prior: what is under the network; without one the body follows its grips rigidly.
            columns: what the columns of Φ stand for, ``PROPERTIES`` first.
            modes: of the linear map beside the messages (``physworld.worldmodel.model.modes``); None: there is none.
        """
        super().__init__()
        self.config = config
        self.spec = spec
        self.columns = columns
        hidden, h, layers = config.hidden, config.history, config.message_passing_steps
        normalisation = normalisation or Normalisation()
        if len(normalisation.properties) != len(columns):
            raise ValueError(f"{len(normalisation.properties)} scales of Φ for {len(columns)} columns")
        vertex_features = 3 * h + 5 + len(normalisation.properties) + (spec.ground_height_m is not None)
        self.encoder = TwoLayers(vertex_features, hidden, hidden)
        self.receive = nn.ModuleList(nn.Linear(hidden, hidden) for _ in range(layers))
        self.send = nn.ModuleList(nn.Linear(hidden, hidden, bias=False) for _ in range(layers))
        self.edge = nn.ModuleList(EdgeWeights(hidden, 3 * h + 8) for _ in range(layers))
        self.update_in = nn.ModuleList(nn.Linear((1 + EDGE_KINDS) * hidden, hidden) for _ in range(layers))
        self.update_out = nn.ModuleList(nn.Linear(hidden, hidden) for _ in range(layers))
        self.decoder = TwoLayers(hidden, hidden, 3)
        self.skip = nn.Linear(vertex_features, 3, bias=False)
        self.modes = None if modes is None else ModalMap(modes)
        for start in (self.skip.weight, self.decoder.out.weight, self.decoder.out.bias):
            nn.init.zeros_(start)  # an untrained network leaves the prior as it is
        self._set_graph(spec)
        self.norm = Scales(normalisation, spec)
        reference = _reference_positions(spec)
        n = spec.object_count
        self.prior = prior_step(prior or rigid_prior(reference[:n], reference[n:], h), h)

    def _set_graph(self, spec: GraphSpec) -> None:
        """The edges, kind by kind, and their constants, in the order of the edge list."""
        reference = _reference_positions(spec)
        self.edges = EdgeList.from_neighbours(spec.neighbours, spec.edge_kind, EDGE_KINDS)
        senders, receivers = self.edges.senders % spec.vertex_count, self.edges.receivers % spec.vertex_count
        rest = spec.rest_relative.reshape(-1, 3)[self.edges.order]
        offset = reference[senders] - reference[receivers]
        share = 1.0 / np.maximum(np.diff(self.edges.offsets), 1).reshape(EDGE_KINDS, -1, 1, 1)
        constants = np.column_stack([offset, offset - rest, np.linalg.norm(rest, axis=1)])
        for name, value in {
            "_reference": reference,
            "_offset": offset,
            "_constants": constants,
            "_share": share,
        }.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)
        self.register_buffer("_senders", senders, persistent=False)
        self.register_buffer("_receivers", receivers, persistent=False)
        kind_of_edge = self.edges.receivers // spec.vertex_count
        self._edges_by_kind = torch.bincount(kind_of_edge, minlength=EDGE_KINDS).tolist()
        self._copies: dict[tuple[int, torch.device], KeptEdges] = {}

    def forward(
        self, window: Tensor, ahead: Tensor, phi: Tensor, constants: EdgeConstants | None = None
    ) -> Tensor:
        """What the prior lacks, in units of σ_change: y (n, B, 3).

        Args:
            window: x^{t-h} … x^t [m], (h+1, V, B, 3).
            ahead: x̂^{t+1} of the object vertices and c^{t+1} [m], (V, B, 3).
            phi: log property ratios of the object vertices, (n, B, 2).
            constants: ``edge_constants()``, when many steps share the weights.
        """
        constants = constants or self.edge_constants()
        n = self.spec.object_count
        moves = (window[1:] - window[:-1]).flip(0)
        grounded = self.spec.ground_height_m is not None
        features = vertex_features(window, moves, ahead, phi, self.norm, grounded=grounded)
        shifted = window[-1] - self._reference[:, None]
        places = torch.cat([shifted, *moves.unbind(0)], dim=-1).flatten(0, 1).expand(EDGE_KINDS, -1, -1)
        means = self._material_means if not self.spec.current_neighbours else self._current_means
        mean_of = means(window[-1], shifted, constants)
        state = self.encoder(features)
        for layer in range(self.config.message_passing_steps):
            placed = torch.bmm(places, constants.position[layer])
            placed = placed.unflatten(1, window.shape[1:3])  # type: ignore[no-untyped-call]  # torch's has no types
            heard, sent = as_seen(self.receive[layer](state), self.send[layer](state), placed)
            mean = mean_of(layer, heard, sent)
            inner = self.update_in[layer](torch.cat([state, *mean.unbind(0)], dim=-1))
            state = state + self.update_out[layer](torch.relu(inner))
        correction: Tensor = self.decoder(state[:n]) + self.skip(features[:n])
        if self.modes is not None:
            correction = correction + self.modes(window, ahead) / self.norm.change
        return correction

    def _material_means(self, now: Tensor, shifted: Tensor, constants: EdgeConstants) -> Means:
        """Mean messages of a layer over the graph's own edges, at places and displacements from the reference (V, B,
        3).
        """
        relative = shifted.index_select(0, self._senders) - shifted.index_select(0, self._receivers)
        length = torch.linalg.vector_norm(relative + self._offset[:, None], dim=-1)

        def mean(layer: int, heard: Tensor, sent: Tensor) -> Tensor:
            return mean_messages(
                self.edges, heard, sent, constants.bias[layer], length, constants.length[layer]
            )

        return mean

    def _current_means(self, now: Tensor, shifted: Tensor, constants: EdgeConstants) -> Means:
        """The same with the NEAR edges of where the vertices are now."""
        batch, spec = shifted.shape[1], self.spec
        key = batch, now.device
        if key not in self._copies:
            self._copies[key] = KeptEdges(self.edges, spec.vertex_count, *key)
        found = CurrentEdges(
            self._copies[key],
            now[: spec.object_count],
            shifted,
            self._reference,
            self._offset,
            neighbours=spec.current_neighbours,
            radius_m=spec.edge_radius_m,
        )

        def mean(layer: int, heard: Tensor, sent: Tensor) -> Tensor:
            return found.means(
                heard, sent, constants.near[layer], constants.bias[layer], constants.length[layer]
            )

        return mean

    def step(
        self,
        window: Tensor,
        control_next: Tensor,
        phi: Tensor,
        constants: EdgeConstants | None = None,
        turn: Turn | None = None,
    ) -> Tensor:
        """Positions of all vertices at t + 1 (V, B, 3) [m].

        Args:
            window: positions at t - h … t (h+1, V, B, 3) [m].
            control_next: where the control vertices go (C, B, 3) [m].
            phi: logarithms of property ratios (n, B, ·).
            constants: what edges share over a rollout; None computes it here.
            turn: of the grip's frame at t + 1 (``frame.turns_ahead``); None computes it here.
        """
        n, frame = self.spec.object_count, self.spec.frame
        if frame is None:
            ahead = torch.cat([self.prior(window, control_next, phi), control_next])
            correction = self.forward(window, ahead, phi, constants)
            return torch.cat([ahead[:n] + self.norm.change * correction, control_next])
        turn, local, control_local = enter(frame, window, control_next, turn)
        ahead = torch.cat([self.prior(local, control_local, phi), control_local])
        correction = self.forward(local, ahead, phi, constants)
        moved = leave(frame, turn, ahead[:n] + self.norm.change * correction)
        return torch.cat([moved, control_next])

    def prior_ahead(
        self, window: Tensor, control_next: Tensor, phi: Tensor, turn: Turn | None = None
    ) -> Tensor:
        """x̂^{t+1} of the object vertices in world axes [m], (n, B, 3), of the same arguments as :meth:`step`."""
        return framed_prior(self.prior, self.spec)(window, control_next, phi, turn)

    def corrects_prior(self) -> bool:
        """Whether the network adds anything to the prior: not before the first step of training."""
        ends = [self.skip.weight, self.decoder.out.weight, self.decoder.out.bias]
        ends += [] if self.modes is None else [self.modes.weight]
        return any(bool(torch.any(weight != 0)) for weight in ends)

    @property
    def shared_columns(self) -> tuple[PhiColumn, ...]:
        """The columns of Φ after its properties: one number each for the whole body."""
        return self.columns[len(PROPERTIES) :]

    def at_strengths(self, strengths: Mapping[str, float]) -> WorldModel:
        """The same function with the shared columns of Φ fixed, by name, as a model of ``PROPERTIES`` alone."""
        names = [one.name for one in self.shared_columns]
        if sorted(strengths) != sorted(names):
            raise ValueError(f"strengths {sorted(strengths)}, the model has {sorted(names)}")
        if not names:
            return self
        kept = len(PROPERTIES)
        values = torch.tensor([strengths[name] for name in names], dtype=self.norm.properties.dtype)
        fixed = copy.deepcopy(self)
        first = 3 * self.config.history + 3 + kept
        scaled = values / self.norm.properties[kept:]
        fixed.encoder.add_module("in", _at_inputs(self.encoder.first, first, scaled))
        fixed.skip = _at_inputs(self.skip, first, scaled)
        fixed.norm.properties = self.norm.properties[:kept].clone()
        fixed.columns = PROPERTIES
        return fixed

    @torch.no_grad()
    def take(self, other: WorldModel) -> None:
        """Go on from the weights of another body's network, which are in units of each body's own scales; its map of
        modes is of that body, and is not taken.

        Shared columns of Φ, and a ground where the other body has none, are not heard at first.

        Raises:
            NetworkMismatch: the other network has another width, depth or history, or hears what this one does not.
        """
        sizes = [
            (one.config.hidden, one.config.message_passing_steps, one.config.history) for one in (self, other)
        ]
        if sizes[0] != sizes[1]:
            raise NetworkMismatch("width, rounds of messages and history {}; the other has {}".format(*sizes))
        grounded = other.spec.ground_height_m is not None
        if other.shared_columns or (grounded and self.spec.ground_height_m is None):
            heard = [one.name for one in other.shared_columns] + ["the height above a ground"] * grounded
            raise NetworkMismatch(f"the other network hears {', '.join(heard)}")
        first = 3 * self.config.history + 3 + len(PROPERTIES)
        kinds = first + len(self.shared_columns)
        learned = dict(other.named_parameters())
        for name, weight in self.named_parameters():
            if name.startswith("modes."):
                continue
            theirs = learned[name]
            if weight.shape == theirs.shape:
                weight.copy_(theirs)
                continue
            weight.zero_()
            weight[:, :first] = theirs[:, :first]
            weight[:, kinds : kinds + theirs.shape[1] - first] = theirs[:, first:]

    def edge_constants(self) -> EdgeConstants:
        """What of the edge products depends on weights and graph only; valid until the weights change."""
        terms = [self._edge_terms(weights) for weights in self.edge_weights()]
        return EdgeConstants(*(tuple(layer[term] for layer in terms) for term in range(4)))

    def edge_weights(self) -> list[Tensor]:
        """``edge.{l}.weight`` (3, H, 3h+8) of every layer."""
        return [cast(EdgeWeights, layer).weight for layer in self.edge]

    def _edge_terms(self, weights: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Bias, position, length and NEAR terms of one layer from its weights (3, H, 3h+8)."""
        h, norm, weight = self.config.history, self.norm, weights.transpose(1, 2)
        strain_scale, drift_scale = norm.strain[:, None, None], norm.relative[:, None, None]
        near, strain = weight[:, 0:3] / norm.length, weight[:, 3:6] / strain_scale
        moves, rest = weight[:, 6 : 6 + 3 * h] / drift_scale, weight[:, 6 + 3 * h] / norm.length
        stretch = weight[:, 7 + 3 * h] / norm.stretch[:, None]
        table = torch.cat([near, strain, (rest - stretch)[:, None]], dim=1)
        parts = self._constants.split(self._edges_by_kind)  # type: ignore[no-untyped-call]  # torch's has no types
        bias = torch.cat([part @ table[kind] for kind, part in enumerate(parts)])
        return bias, torch.cat([near + strain, moves], dim=1), stretch, table[NEAR]


class EdgeWeights(nn.Module):
    """``weight`` (3, H, F): one linear map of the edge features for each kind of edge."""

    def __init__(self, hidden: int, features: int) -> None:
        super().__init__()
        bound = features**-0.5
        self.weight = nn.Parameter(torch.empty(EDGE_KINDS, hidden, features).uniform_(-bound, bound))


def _at_inputs(layer: nn.Linear, first: int, values: Tensor) -> nn.Linear:
    """The layer with the inputs ``first`` … at ``values``; the input after them, 1 for the object, takes their part."""
    last = first + len(values)
    weight = torch.cat([layer.weight[:, :first], layer.weight[:, last:]], dim=1)
    fixed = nn.Linear(weight.shape[1], layer.out_features, bias=layer.bias is not None)
    with torch.no_grad():
        fixed.weight.copy_(weight)
        fixed.weight[:, first] += layer.weight[:, first:last] @ values
        if layer.bias is not None:
            fixed.bias.copy_(layer.bias)
    return fixed


class TwoLayers(nn.Sequential):
    """``in`` → ReLU → ``out``."""

    out: nn.Linear

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.add_module("in", nn.Linear(inputs, hidden))
        self.add_module("relu", nn.ReLU())
        self.add_module("out", nn.Linear(hidden, outputs))

    @property
    def first(self) -> nn.Linear:
        """``in``, whose name is a keyword of the language."""
        return cast(nn.Linear, self.get_submodule("in"))


def _reference_positions(spec: GraphSpec) -> Array:
    """A place of every vertex from which displacements are counted, (V, 3): rest, and near it for
    controllers.
    """
    n = spec.object_count
    reference = np.concatenate([spec.rest_vertices, np.zeros((spec.control_count, 3))])
    for vertex in range(n, spec.vertex_count):
        reference[vertex] = reference[spec.neighbours[vertex, 0]] - spec.rest_relative[vertex, 0]
    centred: Array = reference - reference[:n].mean(axis=0)
    return centred
