"""The graph network of a world model in NumPy: one step, for one body, without a gradient.

The equations and the names of the tensors are those of ``physworld.worldmodel.model.model``; this file is written
from them alone and needs neither torch nor the library. Geometry is computed in double precision, the layers
in single precision, as they were trained.

The NEAR edges of a model that finds them at every step are those of ``physworld.worldmodel.model.nearest``.

Legend: n object vertices, C control vertices, V = n + C; E directed edges, sorted by receiver and kind; H
width; h history; L message passing steps; F edge features, 3h + 8.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from physworld_client.chain import Chain
from physworld_client.errors import ModelUnreadable
from physworld_client.types import Array

EDGE_KINDS = 3  # near, coarse, grip
PROPERTY_COUNT = 2
NEAR = 0
OPPOSITE = 1e-3  # least 1 + cos of the turn of a grip whose points lie on a line
MODES_BOUND = 3.0  # sizes at which what the map of modes sees is cut
REST_RADII = 2.0  # longest rest length that a NEAR edge found at a step tells, in edge radii


@dataclass(frozen=True)
class Edges:
    """Directed edges, sorted by receiver and kind.

    Attributes:
        receivers, senders, kinds: (E,).
        rest: undeformed x_sender - x_receiver [m], (E, 3).
        segments, first: receiver and kind as one number, and where its edges begin, (S,).
        share: one over their number, (S, 1).
    """

    receivers: Array
    senders: Array
    kinds: Array
    rest: Array
    segments: Array
    first: Array
    share: Array

    @classmethod
    def sorted(cls, receivers: Array, senders: Array, kinds: Array, rest: Array) -> Edges:
        """From edges in any order.

        Args:
            receivers: vertex that hears, (E,).
            senders: vertex that is heard, (E,).
            kinds: of the edges, below ``EDGE_KINDS``, (E,).
            rest: what an edge has at rest, (E, ·).
        """
        segments = receivers * EDGE_KINDS + kinds
        order = np.argsort(segments, kind="stable")
        ends, first, counts = np.unique(segments[order], return_index=True, return_counts=True)
        share = (1.0 / counts[:, None]).astype(np.float32)
        return cls(receivers[order], senders[order], kinds[order], rest[order], ends, first, share)

    def of_kind(self, kind: int) -> Array:
        """Rows of that kind."""
        return np.nonzero(self.kinds == kind)[0]


class Network:
    """Encode, process, decode.

    Attributes:
        object_count: n.
        control_count: C.
        history: h; a step sees h + 1 frames.
        has_ground: whether the vertices see their height above the ground.
    """

    def __init__(self, tensors: Mapping[str, Array], object_count: int) -> None:
        self._tensors = tensors
        self.layers = sum(name.startswith("receive.") and name.endswith(".weight") for name in tensors)
        self._nearest = int(tensors.get("graph.current_neighbours", np.zeros(1))[0])
        self._framed = "graph.frame_shape" in tensors
        self._modal_map = "modes.shapes" in tensors
        self._table = "graph.kept_neighbours" if self._nearest else "graph.neighbours"
        if self._framed:
            self._table = "graph.turned_neighbours"
        vertex_count = self._tensor(self._table).shape[0]
        self.object_count = object_count
        self.control_count = vertex_count - object_count
        kinds, _, features = self._tensor("edge.0.weight").shape
        self.history: int = (features - 8) // 3
        inputs = self._tensor("encoder.in.weight").shape[1] - (3 * self.history + 5 + PROPERTY_COUNT)
        fits = features == 3 * self.history + 8 and kinds == EDGE_KINDS and inputs in (0, 1)
        if self.control_count < 0 or not fits:
            raise ModelUnreadable(
                f"the tensors do not fit together: {vertex_count} vertices, {object_count} of the object, "
                f"{kinds} kinds of edges, {features} edge features, {inputs} inputs beyond those of history "
                f"{self.history}"
            )
        self.has_ground = inputs == 1
        self._chain = Chain(tensors) if "prior.spread" in tensors else None
        self._kept = self._kept_edges(vertex_count)
        layers = [self._tensor(f"edge.{layer}.weight") for layer in range(self.layers)]
        self._edge_weights = np.concatenate(layers, axis=1).transpose(0, 2, 1).copy()

    def step(self, window: Array, control_next: Array, phi: Array) -> Array:
        """Positions of all vertices one clock tick later [m], (V, 3).

        Args:
            window: x^{t-h} … x^t [m], (h+1, V, 3), z from the ground where there is one.
            control_next: control vertices at t + 1 [m], (C, 3).
            phi: log property ratios of the object vertices, (n, 2).
        """
        if not self._framed:
            return self._step(window, control_next, phi)
        turn, middle = self._turn(control_next)
        fall = self._tensor("graph.frame_fall").astype(np.float64)
        ticks = np.arange(1 - len(window), 1)[:, None, None]
        local = (window - middle - ticks**2 * fall) @ turn
        moved = self._step(local, (control_next - middle - fall) @ turn, phi)
        return np.concatenate([moved[: self.object_count] @ turn.T + middle + fall, control_next])

    def _turn(self, controls: Array) -> tuple[Array, Array]:
        """R (3, 3) and the middle (3,) of control vertices (C, 3): ``physworld.worldmodel.model.frame``."""
        shape, line = (self._tensor(f"graph.frame_{name}").astype(np.float64) for name in ("shape", "line"))
        middle = controls.mean(axis=0)
        seen = (controls - middle).T @ shape / np.sum(shape**2)
        if line.any():
            onto = seen @ line / np.linalg.norm(seen @ line)
            x, y, z = np.cross(line, onto)
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            return np.eye(3) + cross + cross @ cross / max(1.0 + float(onto @ line), OPPOSITE), middle
        cofactors = np.array([np.cross(seen[(i + 1) % 3], seen[(i + 2) % 3]) for i in range(3)])
        left, _, right = np.linalg.svd(seen + cofactors / np.linalg.norm(seen))
        return np.asarray(left @ right), middle

    def _step(self, window: Array, control_next: Array, phi: Array) -> Array:
        """The same in the axes that it is given in."""
        n = self.object_count
        ahead = np.concatenate([self._prior(window, control_next, phi), control_next])
        features = self._vertex_features(window, ahead, phi)
        state = self._mlp("encoder", features)
        edges = self._edges_at(window[-1]) if self._nearest else self._kept
        terms = self._edge_terms(edges, window)
        for layer in range(self.layers):
            heard = self._linear(f"receive.{layer}", state)
            sent = state @ self._tensor(f"send.{layer}.weight").T
            messages = np.maximum(heard[edges.receivers] + sent[edges.senders] + terms[:, layer], 0.0)
            inner = self._linear(f"update_in.{layer}", np.hstack([state, self._means(edges, messages)]))
            state = state + self._linear(f"update_out.{layer}", np.maximum(inner, 0.0))
        skip = "skip.beside_modes.weight" if self._modal_map else "skip.weight"
        correction = self._mlp("decoder", state[:n]) + features[:n] @ self._tensor(skip).T
        moved = self._scale("change") * correction.astype(np.float64)
        if self._modal_map:
            moved += self._modes(window, ahead)
        ahead[:n] += moved
        return ahead

    def _modes(self, window: Array, ahead: Array) -> Array:
        """What the linear map of modes adds [m], (n, 3): ``physworld.worldmodel.model.modes``."""
        n, frames = self.object_count, window[::-1]
        shapes = self._tensor("modes.shapes").astype(np.float64)
        middle, now = window[-1, n:].mean(axis=0), window[-1]
        moves = frames[:-1] - frames[1:]
        bends = moves[:-1, :n] - moves[1:, :n]
        own = np.concatenate([[now[:n] - middle, moves[0, :n]], bends, [ahead[:n] - now[:n]]])
        held = np.concatenate([[now[n:] - middle, ahead[n:] - now[n:]], moves[:, n:]])
        raw = np.concatenate([np.einsum("rn,pnk->prk", shapes, own).ravel() / n, held.ravel()])
        seen = np.clip(
            (raw - self._tensor("modes.middle")) / self._tensor("modes.scale"), -MODES_BOUND, MODES_BOUND
        )
        moved = (seen @ self._tensor("modes.weight")).reshape(-1, 3) * self._tensor("modes.change")[:, None]
        return np.asarray(shapes.T @ moved)

    def _prior(self, window: Array, control_next: Array, phi: Array) -> Array:
        """x̂^{t+1} of the object vertices [m], (n, 3)."""
        if self._chain is not None:
            return self._chain.ahead(window, control_next, phi)
        if "prior.lags" in self._tensors:
            now, before = self._tensor("prior.lags").astype(np.float64)
            return np.asarray(
                now * window[-1, : self.object_count] + before * window[-2, : self.object_count]
            )
        return self._modal_prior(window, control_next, phi)

    def _modal_prior(self, window: Array, control_next: Array, phi: Array) -> Array:
        """x̂^{t+1} of the object vertices [m], (n, 3)."""
        n = self.object_count
        basis = self._tensor("prior.basis").astype(np.float64)
        mean, shape = self._tensor("prior.mean"), self._tensor("prior.shape")
        controls = np.concatenate([control_next[None], window[::-1, n:]])
        centre = controls.mean(axis=1)
        relative = window[::-1, :n] - centre[1:, None] - mean
        amplitudes = np.einsum("rnx,snx->sr", basis, relative)
        path = np.delete(centre, 1, axis=0) - centre[1]
        shapes = controls - centre[:, None] - shape
        regressors = np.concatenate([amplitudes.ravel(), shapes.ravel(), path.ravel(), [1.0]])
        weight = self._tensor("prior.weight").astype(np.float64)
        if weight.shape != (len(basis), len(regressors)):
            raise ModelUnreadable(f"prior.weight is {weight.shape}, not {(len(basis), len(regressors))}")
        answers = self._tensor("prior.response").astype(np.float64) @ np.append(amplitudes.ravel(), 1.0)
        placed = float(np.sum(self._tensor("prior.placing") * phi))
        softness = float(np.clip(placed, *self._tensor("prior.span")))
        next_amplitudes = weight @ regressors + softness * (answers[0] + softness * answers[1])
        return np.asarray(centre[0] + mean + np.tensordot(next_amplitudes, basis, axes=1))

    def _kept_edges(self, vertex_count: int) -> Edges:
        """The edges of the published table."""
        neighbours = self._tensor(self._table)
        receivers, slots = np.nonzero(neighbours < vertex_count)
        kinds = self._tensor("graph.edge_kind")[receivers, slots]
        rest = self._tensor("graph.rest_relative").astype(np.float64)[receivers, slots]
        return Edges.sorted(receivers, neighbours[receivers, slots], kinds, rest)

    def _edges_at(self, places: Array) -> Edges:
        """The kept edges and the NEAR ones of the places (V, 3): the nearest within the edge radius."""
        n, radius = self.object_count, np.float32(self._scale("length"))
        now, rest = places[:n].astype(np.float32), self._tensor("rest.vertices").astype(np.float64)
        squares = np.square(now[None] - now[:, None]).sum(axis=2)
        np.fill_diagonal(squares, np.inf)
        nearest = np.sort(np.argsort(squares, axis=1, kind="stable")[:, : self._nearest], axis=1)
        receivers, slots = np.nonzero(np.take_along_axis(squares, nearest, axis=1) <= radius * radius)
        senders, kept = nearest[receivers, slots], self._kept
        return Edges.sorted(
            np.concatenate([receivers, kept.receivers]),
            np.concatenate([senders, kept.senders]),
            np.concatenate([np.full(len(receivers), NEAR), kept.kinds]),
            np.concatenate([rest[senders] - rest[receivers], kept.rest]),
        )

    def _means(self, edges: Edges, messages: Array) -> Array:
        """Means of the messages (E, H) by receiver and kind, (V, 3H); 0 where there is no such edge."""
        vertex_count, width = self.object_count + self.control_count, messages.shape[1]
        means = np.zeros((vertex_count * EDGE_KINDS, width), dtype=messages.dtype)
        means[edges.segments] = np.add.reduceat(messages, edges.first, axis=0) * edges.share
        return means.reshape(vertex_count, EDGE_KINDS * width)

    def _vertex_features(self, window: Array, ahead: Array, phi: Array) -> Array:
        """f_i, (V, 3h+7 or 3h+8): own velocities newest first, what lies ahead, properties, kind, height."""
        n, control = self.object_count, self.control_count
        moves = (window[1:] - window[:-1])[::-1] / self._scale("velocity")
        parts = [
            np.moveaxis(moves, 0, 1).reshape(n + control, -1),
            (ahead - window[-1]) / self._scale("velocity"),
            np.concatenate([phi / self._tensor("norm.properties"), np.zeros((control, PROPERTY_COUNT))]),
            np.repeat(np.eye(2), (n, control), axis=0),
        ]
        if self.has_ground:
            parts.append(np.clip(window[-1, :, 2:] / self._scale("length"), 0.0, 1.0))
        return np.concatenate(parts, axis=1).astype(np.float32)

    def _edge_terms(self, edges: Edges, window: Array) -> Array:
        """edge.l.weight[κ] e_ij of every edge and layer, (E, L, H)."""
        relative = window[:, edges.senders] - window[:, edges.receivers]
        length = np.linalg.norm(relative[-1], axis=1, keepdims=True)
        moves = (relative[1:] - relative[:-1])[::-1] / self._scale_by_kind("relative", edges)
        strain = relative[-1] - edges.rest
        rest_length = np.linalg.norm(edges.rest, axis=1, keepdims=True)
        if self._nearest:
            near, radius = (edges.kinds == NEAR)[:, None], self._scale("length")
            size = np.linalg.norm(strain, axis=1, keepdims=True)
            strain = np.where(near, strain * (radius / np.maximum(size, radius)), strain)
            rest_length = np.where(near, np.minimum(rest_length, REST_RADII * radius), rest_length)
        parts = [
            relative[-1] / self._scale("length"),
            strain / self._scale_by_kind("strain", edges),
            *moves,
            rest_length / self._scale("length"),
            (length - rest_length) / self._scale_by_kind("stretch", edges),
        ]
        features = np.concatenate(parts, axis=1).astype(np.float32)
        terms = np.empty((len(features), self._edge_weights.shape[2]), dtype=np.float32)
        for kind in range(EDGE_KINDS):
            rows = edges.of_kind(kind)
            terms[rows] = features[rows] @ self._edge_weights[kind]
        return terms.reshape(len(features), self.layers, -1)

    def _mlp(self, name: str, values: Array) -> Array:
        return self._linear(f"{name}.out", np.maximum(self._linear(f"{name}.in", values), 0.0))

    def _linear(self, name: str, values: Array) -> Array:
        return values @ self._tensor(f"{name}.weight").T + self._tensor(f"{name}.bias")

    def _scale(self, name: str) -> float:
        return float(self._tensor(f"norm.{name}")[0])

    def _scale_by_kind(self, name: str, edges: Edges) -> Array:
        """σ_name[κ] of every edge, (E, 1)."""
        return self._tensor(f"norm.{name}").astype(np.float64)[edges.kinds][:, None]

    def _tensor(self, name: str) -> Array:
        try:
            return self._tensors[name]
        except KeyError:
            raise ModelUnreadable(f"the weights lack the tensor {name!r}") from None
