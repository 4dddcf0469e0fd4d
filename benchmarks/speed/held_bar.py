"""The network that the speed of rollouts and training is measured on: a bar held at one end."""

from __future__ import annotations

import numpy as np
import torch

from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.features import Normalisation
from physworld.worldmodel.model.graph import GraphSpec, build_graph
from physworld.worldmodel.model.model import WorldModel

VERTICES, CONTROLS, SPACING_M = 146, 4, 0.01


def held_bar(hidden: int, seed: int, near_edges: str = "material") -> tuple[WorldModel, GraphSpec]:
    """A bar held at one end, random weights."""
    axes = (np.arange(40), np.arange(8), np.arange(8))
    bar = SPACING_M * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    config = WorldModelConfig(
        hidden=hidden,
        message_passing_steps=7,
        vertices=VERTICES,
        neighbours=7,
        coarse_vertices=8,
        near_edges=near_edges,
    )
    groups = (np.arange(CONTROLS),)
    spec = build_graph(bar, bar, bar[:CONTROLS], dt_s=1 / 30, config=config, control_groups=groups)
    scales = Normalisation(3e-3, 1e-3, (1e-3,) * 3, (4e-3,) * 3, (4e-3,) * 3, (0.2, 0.1))
    torch.manual_seed(seed)
    model = WorldModel(config, spec, scales)
    with torch.no_grad():  # they start at zero, and the engine leaves out a network that adds nothing
        model.skip.weight.normal_(0.0, 0.01)
        model.decoder.out.weight.normal_(0.0, 0.01)
    return model, spec


def held_bar_sequence(spec: GraphSpec, seed: int, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start (h+1, n, 3), control path (T, C, 3), properties (n, 2)."""
    rng = np.random.default_rng(seed)
    start = spec.rest_vertices + rng.normal(0.0, 1e-3, (4, spec.object_count, 3))
    controls = spec.rest_vertices[spec.neighbours[spec.object_count :, 0]]
    sway = 0.01 * np.sin(0.3 * np.arange(frames))[:, None, None]
    return start, controls + sway, rng.normal(0.0, 0.1, (spec.object_count, 2))
