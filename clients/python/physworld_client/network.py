"""The graph network of a world model in NumPy: one step, for one body, without a gradient.

The equations and the names of the tensors are those of ``physworld.worldmodel.model``; this file is written
from them alone and needs neither torch nor the library. Geometry is computed in double precision, the layers
in single precision, as they were trained.

Legend: n object vertices, C control vertices, V = n + C; D neighbour slots per vertex; H width; h history; L
message passing steps; F edge features, 3h + 10.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from physworld_client.errors import ModelUnreadable

EMPTY_SLOT = np.float32(-1.0e9)  # added before the ReLU of a message that nobody sends
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
        vertex_count, slots = neighbours.shape
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
        self._prepare(neighbours, slots)

    def step(self, window: np.ndarray, control_next: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """Positions of all vertices one clock tick later [m], (V, 3).

        Args:
            window: x^{t-h} … x^t [m], (h+1, V, 3), z from the ground where there is one.
            control_next: control vertices at t + 1 [m], (C, 3).
            phi: log property ratios of the object vertices, (n, 2).
        """
        n = self.object_count
        state = self._mlp("encoder", self._vertex_features(window, control_next - window[-1, n:], phi))
        edges = self._edge_features(window) @ self._edge_weights
        edges = edges.reshape(len(state), -1, self.layers, state.shape[1])
        for layer in range(self.layers):
            heard = self._linear(f"receive.{layer}", state)
            sent = np.concatenate([state @ self._tensor(f"send.{layer}.weight").T, self._silent])
            messages = heard[:, None] + sent[self._neighbours] + edges[:, :, layer]
            total = np.maximum(messages, 0.0).sum(axis=1) / self._degree
            received = total @ self._tensor(f"message.{layer}.weight").T
            inner = self._linear(f"update_in.{layer}", np.concatenate([state, received], axis=1))
            state = state + self._linear(f"update_out.{layer}", np.maximum(inner, 0.0))
        correction = self._mlp("decoder", state[:n]).astype(np.float64)
        inertial = 2.0 * window[-1, :n] - window[-2, :n]
        return np.concatenate([inertial + self._scale("acceleration") * correction, control_next])

    def _prepare(self, neighbours: np.ndarray, slots: int) -> None:
        """What depends on weights and graph only."""
        vertex_count, n = neighbours.shape[0], self.object_count
        receiver = np.broadcast_to(np.arange(vertex_count)[:, None], neighbours.shape)
        filled = neighbours < vertex_count
        controlled = (receiver >= n) | (neighbours >= n)
        rest = self._tensor("graph.rest_relative").astype(np.float64)
        self._neighbours = neighbours
        self._senders = np.where(filled, neighbours, receiver)
        self._rest = rest
        self._rest_length = np.linalg.norm(rest, axis=2, keepdims=True)
        self._kind = np.stack([~controlled, controlled], axis=2).astype(np.float64)
        width = self._tensor("decoder.in.weight").shape[1]
        self._silent = np.full((1, width), EMPTY_SLOT)
        self._degree = np.float32(self._scale("degree"))
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
        """e_ij of every slot, (V, D, F); those of empty slots are never heard."""
        relative = window[:, self._senders] - window[:, :, None]
        length = np.linalg.norm(relative[-1], axis=2, keepdims=True)
        moves = (relative[1:] - relative[:-1])[::-1] / self._scale("relative")
        parts = [
            relative[-1] / self._scale("length"),
            (relative[-1] - self._rest) / self._scale("strain"),
            *moves,
            self._rest_length / self._scale("length"),
            (length - self._rest_length) / self._scale("stretch"),
            self._kind,
        ]
        return np.concatenate(parts, axis=2).astype(np.float32)

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
