"""The graph network of a world model in NumPy: one step, for one body, without a gradient.

The equations and the names of the tensors are those of ``physworld.worldmodel.model``; this file is written
from them alone and needs neither torch nor the library. Geometry is computed in double precision, the layers
in single precision, as they were trained.

Legend: n object vertices, C control vertices, V = n + C; E directed edges, sorted by receiver; H width; h
history; L message passing steps; F edge features, 3h + 10.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from physworld_client.errors import ModelUnreadable

PROPERTY_COUNT = 2


class Network:
    """Encode, process, decode.

    Attributes:
        object_count: n. control_count: C. history: h.
        has_ground: whether the vertices see their height above the ground.
    """

    def __init__(self, tensors: Mapping[str, np.ndarray], object_count: int) -> None:
        self._tensors = tensors
        self.layers = sum(name.startswith("receive.") and name.endswith(".weight") for name in tensors)
        neighbours = self._tensor("graph.neighbours").astype(np.int64)
        vertex_count = neighbours.shape[0]
        self.object_count = object_count
        self.control_count = vertex_count - object_count
        features = self._tensor("edge.0.weight").shape[1]
        self.history = (features - 10) // 3
        inputs = self._tensor("encoder.in.weight").shape[1] - (3 * self.history + 5 + PROPERTY_COUNT)
        if self.control_count < 0 or features != 3 * self.history + 10 or inputs not in (0, 1):
            raise ModelUnreadable(
                f"the tensors do not fit together: {vertex_count} vertices, {object_count} of the object, "
                f"{features} edge features, {inputs} inputs beyond those of history {self.history}"
            )
        self.has_ground = inputs == 1
        self._prepare(neighbours)

    def step(self, window: np.ndarray, control_next: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """Positions of all vertices one clock tick later [m], (V, 3).

        Args:
            window: x^{t-h} … x^t [m], (h+1, V, 3), z from the ground where there is one.
            control_next: control vertices at t + 1 [m], (C, 3).
            phi: log property ratios of the object vertices, (n, 2).
        """
        n = self.object_count
        features = self._vertex_features(window, control_next - window[-1, n:], phi)
        state = self._mlp("encoder", features)
        edges = self._edge_features(window) @ self._edge_weights
        edges = edges.reshape(len(edges), self.layers, -1)
        for layer in range(self.layers):
            heard = self._linear(f"receive.{layer}", state)
            sent = state @ self._tensor(f"send.{layer}.weight").T
            messages = np.maximum(heard[self._receivers] + sent[self._senders] + edges[:, layer], 0.0)
            mean = np.add.reduceat(messages, self._first, axis=0) * self._share
            received = mean @ self._tensor(f"message.{layer}.weight").T
            inner = self._linear(f"update_in.{layer}", np.concatenate([state, received], axis=1))
            state = state + self._linear(f"update_out.{layer}", np.maximum(inner, 0.0))
        correction = self._mlp("decoder", state[:n]) + features[:n] @ self._tensor("skip.weight").T
        inertial = 2.0 * window[-1, :n] - window[-2, :n]
        moved = inertial + self._scale("acceleration") * correction.astype(np.float64)
        return np.concatenate([moved, control_next])

    def _prepare(self, neighbours: np.ndarray) -> None:
        """What depends on weights and graph only."""
        vertex_count, n = neighbours.shape[0], self.object_count
        receivers, slots = np.nonzero(neighbours < vertex_count)
        degree = np.bincount(receivers, minlength=vertex_count)
        if not degree.all():
            raise ModelUnreadable(f"vertex {int(np.argmin(degree))} of the graph hears nobody")
        self._receivers, self._senders = receivers, neighbours[receivers, slots]
        self._first = np.concatenate([[0], np.cumsum(degree)[:-1]])
        self._share = (1.0 / degree[:, None]).astype(np.float32)
        self._rest = self._tensor("graph.rest_relative").astype(np.float64)[receivers, slots]
        self._rest_length = np.linalg.norm(self._rest, axis=1, keepdims=True)
        controlled = (receivers >= n) | (self._senders >= n)
        self._kind = np.stack([~controlled, controlled], axis=1).astype(np.float64)
        layers = [self._tensor(f"edge.{layer}.weight") for layer in range(self.layers)]
        self._edge_weights = np.concatenate(layers).T.copy()

    def _vertex_features(self, window: np.ndarray, action: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """f_i, (V, 3h+7 or 3h+8): own velocities newest first, action, properties, kind, height."""
        n, control = self.object_count, self.control_count
        moves = (window[1:] - window[:-1])[::-1] / self._scale("velocity")
        parts = [
            np.moveaxis(moves, 0, 1).reshape(n + control, -1),
            np.concatenate([np.zeros((n, 3)), action / self._scale("velocity")]),
            np.concatenate([phi / self._tensor("norm.properties"), np.zeros((control, PROPERTY_COUNT))]),
            np.repeat(np.eye(2), (n, control), axis=0),
        ]
        if self.has_ground:
            parts.append(np.clip(window[-1, :, 2:] / self._scale("length"), 0.0, 1.0))
        return np.concatenate(parts, axis=1).astype(np.float32)

    def _edge_features(self, window: np.ndarray) -> np.ndarray:
        """e_ij, (E, F)."""
        relative = window[:, self._senders] - window[:, self._receivers]
        length = np.linalg.norm(relative[-1], axis=1, keepdims=True)
        moves = (relative[1:] - relative[:-1])[::-1] / self._scale("relative")
        parts = [
            relative[-1] / self._scale("length"),
            (relative[-1] - self._rest) / self._scale("strain"),
            *moves,
            self._rest_length / self._scale("length"),
            (length - self._rest_length) / self._scale("stretch"),
            self._kind,
        ]
        return np.concatenate(parts, axis=1).astype(np.float32)

    def _mlp(self, name: str, values: np.ndarray) -> np.ndarray:
        return self._linear(f"{name}.out", np.maximum(self._linear(f"{name}.in", values), 0.0))

    def _linear(self, name: str, values: np.ndarray) -> np.ndarray:
        return values @ self._tensor(f"{name}.weight").T + self._tensor(f"{name}.bias")

    def _scale(self, name: str) -> float:
        return float(self._tensor(f"norm.{name}")[0])

    def _tensor(self, name: str) -> np.ndarray:
        try:
            return self._tensors[name]
        except KeyError:
            raise ModelUnreadable(f"the weights lack the tensor {name!r}") from None
