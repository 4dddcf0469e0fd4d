"""Open-loop rollouts of the world model.

A rollout starts from h + 1 known frames of the object (from rest: the same frame h + 1 times, with the
controllers still) and is driven by controllers on the model's clock. Positions are counted from the start's
middle, in single precision. What shares one start goes through the native engine, one sequence or a batch of
candidates; episodes that each start elsewhere go through torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from physworld.arrays import Array
from physworld.worldmodel.dataset import Track, graph_origin
from physworld.worldmodel.errors import GraphInvalid
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.native.engine import RolloutEngine

Step = Callable[[Tensor, Tensor, Tensor], Tensor]
"""All vertices at t + 1 (V, B, 3) from a window (h+1, V, B, 3), control vertices at t + 1 and Φ (n, B, ·)."""


def rollout(
    model: WorldModel,
    spec: GraphSpec,
    initial_history: Array,
    controllers: Array,
    phi: Array,
) -> Array:
    """Object vertices over time [m], (T, n, 3) float64.

    Args:
        model: the network; ``spec`` its graph.
        initial_history: object vertices at frames 0 … h of the clock [m], (h+1, n, 3); the result starts so.
        controllers: all controllers at frames 0 … T-1 [m], (T, K, 3).
        phi: log property ratios, (n, 2).
    """
    batch = rollout_batch(RolloutEngine(model), spec, initial_history, controllers[None], phi)
    return np.asarray(batch[0])


def rollout_batch(
    engine: RolloutEngine,
    spec: GraphSpec,
    initial_history: Array,
    controllers: Array,
    phi: Array,
    *,
    threads: int = 1,
) -> Array:
    """Object vertices of every candidate [m], (B, T, n, 3) float64.

    Args:
        engine: the model's engine; ``spec`` its graph.
        initial_history: object vertices at frames 0 … h of the clock [m], (h+1, n, 3), for all candidates.
        controllers: all controllers of every candidate at frames 0 … T-1 [m], (B, T, K, 3).
        phi: log property ratios, (n, 2), or (B, n, 2) with one set a candidate.
        threads: that share the candidates.

    Raises GraphInvalid for arrays of other shapes and for values that are not finite.
    """
    frames, n = engine.history + 1, spec.object_count
    expected = ((frames, n, 3), (n, 2))
    if (initial_history.shape, phi.shape[-2:]) != expected:
        raise GraphInvalid(f"history and phi of shapes {initial_history.shape}, {phi.shape}, not {expected}")
    if controllers.shape[1] < frames or controllers.shape[2] <= int(spec.control_index.max(initial=0)):
        raise GraphInvalid(
            f"controllers of shape {controllers.shape[1:]} do not drive a history of {frames} frames"
        )
    broken = sum(np.count_nonzero(~np.isfinite(part)) for part in (controllers, initial_history, phi))
    if broken:
        raise GraphInvalid(f"{broken} values of controllers, history and phi are not finite")
    origin = graph_origin(spec, initial_history[-1])
    predicted = engine.run_batch(
        initial_history - origin, controllers[:, :, spec.control_index] - origin, phi, threads=threads
    )
    return predicted[:, :, :n].astype(np.float64) + origin


def rollout_tracks(model: WorldModel, tracks: list[Track]) -> list[Tensor]:
    """Rollouts (T, V, 3) of episodes from their first h + 1 frames, all in one batch on the model's device."""
    device = model.norm.change.device
    there = [Track(track.positions.to(device), track.phi.to(device)) for track in tracks]
    moved = unroll_tracks(_with_constants(model), there, model.spec.object_count, model.config.history)
    return [path.cpu() for path in moved]


def unroll_tracks(step: Step, tracks: list[Track], n: int, history: int) -> list[Tensor]:
    """The same with any ``step``.

    Args:
        step: (window, control vertices, Φ) to all vertices at t + 1.
        tracks: the episodes.
        n: object vertices.
        history: h.
    """
    lengths = [track.positions.shape[0] for track in tracks]
    longest = max(lengths)
    padded = torch.stack([_held(track.positions, longest) for track in tracks], dim=2)
    phi = torch.stack([track.phi for track in tracks], dim=1)
    predicted = _unroll(step, padded[: history + 1, :n], padded[:, n:], phi)
    return [predicted[:length, :, i] for i, length in enumerate(lengths)]


def unroll(model: WorldModel, start: Tensor, driven: Tensor, phi: Tensor) -> Tensor:
    """All vertices of B rollouts (T, V, B, 3) [m].

    Args:
        model: makes the steps.
        start: object vertices of the first frames (h+1, n, B, 3) [m].
        driven: control vertices of all frames (T, C, B, 3) [m].
        phi: logarithms of property ratios (n, B, ·).
    """
    return _unroll(_with_constants(model), start, driven, phi)


def _unroll(step: Step, start: Tensor, driven: Tensor, phi: Tensor) -> Tensor:
    frames = start.shape[0]
    with torch.inference_mode():
        path = list(torch.cat([start, driven[:frames]], dim=1))
        for t in range(frames, driven.shape[0]):
            path.append(step(torch.stack(path[-frames:]), driven[t], phi))
        return torch.stack(path)


def _with_constants(model: WorldModel) -> Step:
    """The model's step, its edge constants computed once."""
    with torch.inference_mode():
        constants = model.edge_constants()
    return lambda window, control_next, phi: model.step(window, control_next, phi, constants)


def mean_error(predicted: list[Tensor], tracks: list[Track], spec: GraphSpec) -> float:
    """Mean distance [m] over frames, object vertices and episodes; infinite where a rollout left the numbers."""
    n = spec.object_count
    errors = [
        torch.linalg.vector_norm(guess[:, :n].double() - track.positions[:, :n].double(), dim=-1).mean()
        for guess, track in zip(predicted, tracks, strict=True)
    ]
    mean = float(torch.stack(errors).mean())
    return mean if math.isfinite(mean) else math.inf


def _held(positions: Tensor, frames: int) -> Tensor:
    """Padded with its last frame to ``frames``."""
    return torch.cat([positions, positions[-1:].expand(frames - positions.shape[0], -1, -1)])
