"""One step of the world model as a program without our code: ``torch.export`` and ONNX.

    next = step(window, control_next, phi, senders, receivers, kinds, rest_relative)

    window         (h+1, V, 3)  x^{t-h} … x^t [m], object vertices first; z from the ground where there is one
    control_next   (C, 3)       control vertices at t + 1 [m]
    phi            (n, 2)       log property ratios of the object vertices
    senders, receivers, kinds   (E,) int64: who is heard, by whom, and the kind of the edge (0 near, 1 coarse, 2 grip)
    rest_relative  (E, 3)       undeformed x_sender − x_receiver of each edge [m]
    next           (V, 3)       all vertices at t + 1 [m]

float32 but for the indices. V, C, n and h are the model's; the number of edges E is free, so that another graph over
the same vertices (an edge that tore, a contact) can be given at each step; ``edge_list`` is the model's own. A model
whose NEAR edges are those of the current shape (``physworld.worldmodel.model.nearest``) is given them by its caller:
the search is no part of the program. The equations are those of ``physworld.worldmodel.model.model``, written edge by
edge: the split form keeps its constants per graph and would freeze E. The substeps of a rope's chain are unrolled: one
to two thousand operations more.
"""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from physworld.arrays import Array
from physworld.worldmodel.model.features import edge_features, vertex_features
from physworld.worldmodel.model.frame import enter, leave
from physworld.worldmodel.model.graph import EDGE_KINDS, NEAR, GraphSpec
from physworld.worldmodel.model.model import EdgeWeights, WorldModel
from physworld.worldmodel.model.nearest import near_ends
from physworld.worldmodel.priors.chain_step import ChainStep

INPUTS = ("window", "control_next", "phi", "senders", "receivers", "kinds", "rest_relative")
OUTPUT = "next"
ONNX_OPSET = 18


class StepProgram(nn.Module):
    """The step in plain torch; see the module's text for inputs and output."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        spec = model.spec
        self.objects, self.vertices = spec.object_count, spec.vertex_count
        self.grounded = spec.ground_height_m is not None
        # Modules by names that are no Python keywords (``encoder.in`` is): the exporters write code with them.
        self.encoder, self.decoder = nn.Sequential(*model.encoder), nn.Sequential(*model.decoder)
        self.receive, self.send, self.edge = model.receive, model.send, model.edge
        self.update_in, self.update_out, self.skip = model.update_in, model.update_out, model.skip
        self.norm, self.prior, self.modes = model.norm, model.prior, model.modes
        self.frame = spec.frame
        self.radius = spec.edge_radius_m if spec.current_neighbours else None

    def forward(
        self,
        window: Tensor,
        control_next: Tensor,
        phi: Tensor,
        senders: Tensor,
        receivers: Tensor,
        kinds: Tensor,
        rest_relative: Tensor,
    ) -> Tensor:
        """Positions (V, 3) at t + 1.

        Args:
            window: last h + 1 positions of all vertices (h+1, V, 3) [m].
            control_next: control vertices at t + 1 (C, 3) [m].
            phi: logarithms of property ratios (n, ·).
            senders: vertex that every edge comes from, (E,) int64.
            receivers: vertex that it goes to, (E,) int64.
            kinds: of the edges, (E,) int64.
            rest_relative: sender minus receiver at rest (E, 3) [m].
        """
        n, count, frame = self.objects, self.vertices, self.frame
        moved_to = control_next
        if frame is not None:
            turn, local, ahead_of = enter(frame, window[:, :, None], control_next[:, None])
            window, control_next = local[:, :, 0], ahead_of[:, 0]
        prior = self.prior(window[:, :, None], control_next[:, None], phi[:, None])[:, 0]
        ahead = torch.cat([prior, control_next])
        moves = (window[1:] - window[:-1]).flip(0)
        features = vertex_features(window, moves, ahead, phi, self.norm, grounded=self.grounded)
        of_kind = nn.functional.one_hot(kinds, EDGE_KINDS).to(window.dtype)
        relative = window.index_select(1, senders) - window.index_select(1, receivers)
        edges = edge_features(relative, rest_relative, kinds, self.norm, self.radius)
        by_kind = (of_kind[:, :, None] * edges[:, None, :]).flatten(1)
        ends = kinds * count + receivers
        degree = window.new_zeros(EDGE_KINDS * count).scatter_add(0, ends, torch.ones_like(edges[:, 0]))
        state = self.encoder(features)
        for layer in range(len(self.receive)):
            weight = cast(EdgeWeights, self.edge[layer]).weight.transpose(1, 2).flatten(0, 1)
            heard, sent = self.receive[layer](state), self.send[layer](state)
            messages = torch.relu(
                heard.index_select(0, receivers) + sent.index_select(0, senders) + by_kind @ weight
            )
            total = torch.zeros_like(state).repeat(EDGE_KINDS, 1)
            total = total.scatter_add(0, ends[:, None].expand_as(messages), messages)
            means = total / degree.clamp(min=1.0)[:, None]
            means = means.unflatten(0, (EDGE_KINDS, count))  # type: ignore[no-untyped-call]  # torch's has no types
            inner = self.update_in[layer](torch.cat([state, *means.unbind(0)], dim=-1))
            state = state + self.update_out[layer](torch.relu(inner))
        correction = self.decoder(state[:n]) + self.skip(features[:n])
        moved = prior + self.norm.change * correction
        if self.modes is not None:
            moved = moved + self.modes(window[:, :, None], ahead[:, None])[:, 0]
        if frame is not None:
            moved = leave(frame, turn, moved[:, None])[:, 0]
        return torch.cat([moved, moved_to])


def edge_list(spec: GraphSpec, places: Array | None = None) -> dict[str, Array]:
    """The model's own edges as the program takes them.

    With ``places`` (V or n, 3) [m] also its NEAR edges there, if they are those of the current shape.
    """
    receivers, slots = np.nonzero(spec.neighbours < spec.vertex_count)
    edges: dict[str, Array] = {
        "senders": spec.neighbours[receivers, slots].astype(np.int64),
        "receivers": receivers.astype(np.int64),
        "kinds": spec.edge_kind[receivers, slots].astype(np.int64),
        "rest_relative": spec.rest_relative[receivers, slots].astype(np.float32),
    }
    if places is None or not spec.current_neighbours:
        return edges
    n, rest = spec.object_count, spec.rest_vertices.astype(np.float32)
    _, hears, heard = near_ends(places[None, :n], spec.current_neighbours, spec.edge_radius_m)
    near: dict[str, Array] = {
        "senders": heard,
        "receivers": hears,
        "kinds": np.full(len(heard), NEAR),
        "rest_relative": rest[heard] - rest[hears],
    }
    return {name: np.concatenate([near[name], values], dtype=values.dtype) for name, values in edges.items()}


def example_inputs(model: WorldModel) -> dict[str, Array]:
    """Inputs of the program at rest."""
    spec, frames = model.spec, model.config.history + 1
    rest: Array = model._reference.numpy(force=True)
    return {
        "window": np.repeat(rest[None], frames, axis=0).astype(np.float32),
        "control_next": rest[spec.object_count :].astype(np.float32),
        "phi": np.zeros((spec.object_count, model.norm.properties.shape[0]), dtype=np.float32),
        **edge_list(spec, rest),
    }


def torch_program(model: WorldModel) -> bytes:
    """A ``.pt2`` file: ``torch.export.load(file).module()(*inputs)``."""
    buffer = io.BytesIO()
    torch.export.save(_exported(model), buffer)
    return buffer.getvalue()


def onnx_program(model: WorldModel) -> bytes:
    """An ONNX file with the inputs ``INPUTS`` and the output ``next``. Needs onnx and onnxscript."""
    with _quiet():
        program = torch.onnx.export(
            _exported(model),
            input_names=list(INPUTS),
            output_names=[OUTPUT],
            opset_version=ONNX_OPSET,
            dynamo=True,
            verbose=False,
            optimize=not isinstance(model.prior, ChainStep),  # a minute for what a runtime does by itself
        )
    content: bytes = cast(torch.onnx.ONNXProgram, program).model_proto.SerializeToString()
    return content


def _exported(model: WorldModel) -> torch.export.ExportedProgram:
    inputs = tuple(torch.as_tensor(values) for values in example_inputs(model).values())
    edges = torch.export.Dim("edges", min=1)
    shapes = dict.fromkeys(INPUTS[:3]) | {name: {0: edges} for name in INPUTS[3:]}
    with torch.no_grad():
        return torch.export.export(StepProgram(model).eval(), inputs, dynamic_shapes=shapes, strict=False)


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter warns of its own internals and logs what it did."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)
