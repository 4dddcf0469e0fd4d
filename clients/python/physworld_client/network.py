"""The graph network of a world model in NumPy: one step, for one body, without a gradient.

The equations and the names of the tensors are those of ``physworld.worldmodel.model``; this file is written
from them alone and needs neither torch nor the library. Geometry is computed in double precision, the layers
in single precision, as they were trained.

Legend: n object vertices, C control vertices, V = n + C; E directed edges, sorted by receiver and kind; H
width; h history; L message passing steps; F edge features, 3h + 8.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from physworld_client.chain import Chain
from physworld_client.errors import ModelUnreadable

EDGE_KINDS = 3  # near, coarse, grip
PROPERTY_COUNT = 2


class Network:
    """Encode, process, decode.

    Attributes:
        object_count: n.
        control_count: C.
        history: h; a step sees h + 1 frames.
        has_ground: whether the vertices see their height above the ground.
    """

    def __init__(self, tensors: Mapping[str, np.ndarray], object_count: int) -> None:
        self._tensors = tensors
        self.layers = sum(name.startswith("receive.") and name.endswith(".weight") for name in tensors)
        vertex_count = self._tensor("graph.neighbours").shape[0]
        self.object_count = object_count
        self.control_count = vertex_count - object_count
        kinds, _, features = self._tensor("edge.0.weight").shape
        self.history = (features - 8) // 3
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
        self._sort_edges(vertex_count)
        layers = [self._tensor(f"edge.{layer}.weight") for layer in range(self.layers)]
        self._edge_weights = np.concatenate(layers, axis=1).transpose(0, 2, 1).copy()

    def step(self, window: np.ndarray, control_next: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """Positions of all vertices one clock tick later [m], (V, 3).

        Args:
            window: x^{t-h} … x^t [m], (h+1, V, 3), z from the ground where there is one.
            control_next: control vertices at t + 1 [m], (C, 3).
            phi: log property ratios of the object vertices, (n, 2).
        """
        n = self.object_count
        prior = self._modal_prior if self._chain is None else self._chain.ahead
        ahead = np.concatenate([prior(window, control_next, phi), control_next])
        features = self._vertex_features(window, ahead, phi)
        state = self._mlp("encoder", features)
        edges = self._edge_terms(window)
        for layer in range(self.layers):
            heard = self._linear(f"receive.{layer}", state)
            sent = state @ self._tensor(f"send.{layer}.weight").T
            messages = np.maximum(heard[self._receivers] + sent[self._senders] + edges[:, layer], 0.0)
            inner = self._linear(f"update_in.{layer}", np.hstack([state, self._means(messages)]))
            state = state + self._linear(f"update_out.{layer}", np.maximum(inner, 0.0))
        correction = self._mlp("decoder", state[:n]) + features[:n] @ self._tensor("skip.weight").T
        ahead[:n] += self._scale("change") * correction.astype(np.float64)
        return ahead

    def _modal_prior(self, window: np.ndarray, control_next: np.ndarray, phi: np.ndarray) -> np.ndarray:
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

    def _sort_edges(self, vertex_count: int) -> None:
        """The edge list, and where the edges of one receiver and kind begin in it."""
        neighbours = self._tensor("graph.neighbours")
        receivers, slots = np.nonzero(neighbours < vertex_count)
        kinds = self._tensor("graph.edge_kind")[receivers, slots]
        segments = receivers * EDGE_KINDS + kinds
        order = np.argsort(segments, kind="stable")
        receivers, slots, self._kinds = receivers[order], slots[order], kinds[order]
        self._receivers, self._senders = receivers, neighbours[receivers, slots]
        self._rest = self._tensor("graph.rest_relative").astype(np.float64)[receivers, slots]
        self._rest_length = np.linalg.norm(self._rest, axis=1, keepdims=True)
        self._segments, self._first, counts = np.unique(
            segments[order], return_index=True, return_counts=True
        )
        self._share = (1.0 / counts[:, None]).astype(np.float32)
        self._of_kind = [np.nonzero(self._kinds == kind)[0] for kind in range(EDGE_KINDS)]

    def _means(self, messages: np.ndarray) -> np.ndarray:
        """Means of the messages (E, H) by receiver and kind, (V, 3H); 0 where there is no such edge."""
        vertex_count, width = self.object_count + self.control_count, messages.shape[1]
        means = np.zeros((vertex_count * EDGE_KINDS, width), dtype=messages.dtype)
        means[self._segments] = np.add.reduceat(messages, self._first, axis=0) * self._share
        return means.reshape(vertex_count, EDGE_KINDS * width)

    def _vertex_features(self, window: np.ndarray, ahead: np.ndarray, phi: np.ndarray) -> np.ndarray:
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

    def _edge_terms(self, window: np.ndarray) -> np.ndarray:
        """edge.l.weight[κ] e_ij of every edge and layer, (E, L, H)."""
        relative = window[:, self._senders] - window[:, self._receivers]
        length = np.linalg.norm(relative[-1], axis=1, keepdims=True)
        moves = (relative[1:] - relative[:-1])[::-1] / self._scale_by_kind("relative")
        parts = [
            relative[-1] / self._scale("length"),
            (relative[-1] - self._rest) / self._scale_by_kind("strain"),
            *moves,
            self._rest_length / self._scale("length"),
            (length - self._rest_length) / self._scale_by_kind("stretch"),
        ]
        features = np.concatenate(parts, axis=1).astype(np.float32)
        terms = np.empty((len(features), self._edge_weights.shape[2]), dtype=np.float32)
        for kind, edges in enumerate(self._of_kind):
            terms[edges] = features[edges] @ self._edge_weights[kind]
        return terms.reshape(len(features), self.layers, -1)

    def _mlp(self, name: str, values: np.ndarray) -> np.ndarray:
        return self._linear(f"{name}.out", np.maximum(self._linear(f"{name}.in", values), 0.0))

    def _linear(self, name: str, values: np.ndarray) -> np.ndarray:
        return values @ self._tensor(f"{name}.weight").T + self._tensor(f"{name}.bias")

    def _scale(self, name: str) -> float:
        return float(self._tensor(f"norm.{name}")[0])

    def _scale_by_kind(self, name: str) -> np.ndarray:
        """σ_name[κ] of every edge, (E, 1)."""
        return self._tensor(f"norm.{name}").astype(np.float64)[self._kinds][:, None]

    def _tensor(self, name: str) -> np.ndarray:
        try:
            return self._tensors[name]
        except KeyError:
            raise ModelUnreadable(f"the weights lack the tensor {name!r}") from None
