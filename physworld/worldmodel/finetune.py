"""Fine-tuning of Φ on a recording, weights frozen (paper, section Physical Property Fine-Tuning).

The open-loop rollout over the recording's fitting frames is cut into segments of ``window`` steps. Each
step of the optimisation unrolls all segments at once (a batch) from the rollout's own states and compares
the skinned tracked points with the visible measured ones:

    loss = MSE / s² + chamfer_weight · Chamfer / s + smoothness_weight · ‖(Φ - Φ_start) / σ_properties‖²

where s is the root-mean-square excursion of the measured points and Chamfer goes from the measured points
to the nearest predicted ones. Strengths of effects that the model takes (``WorldModel.shared_columns``) are optimised
with Φ, one number each for the whole body, and kept within their intervals. The states are refreshed by a new rollout
each time the inner validation is made. That one, the open-loop error on the last share of the *training* frames,
decides when to stop and whether the result is kept at all: a Φ is thrown away unless the whole 95 % interval of its
gain over the calibrated one is above zero there (``physworld.estimation.blocks.paired_gain``). Neighbouring frames err
alike: a few per cent may be chance, which the frames after them take back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from physworld.arrays import Array
from physworld.estimation.blocks import paired_gain
from physworld.worldmodel.dataset import graph_origin
from physworld.worldmodel.errors import TrainingCancelled
from physworld.worldmodel.model.config import FineTuneConfig
from physworld.worldmodel.model.frame import turns_ahead
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.properties import PROPERTIES
from physworld.worldmodel.model.skinning import Skin
from physworld.worldmodel.native.engine import RolloutEngine

CHECK_EVERY = 5
PATIENCE_CHECKS = 4


@dataclass(frozen=True)
class Recording:
    """Measured points on the model's clock; tick 0 is the first frame of ``history``.

    Attributes:
        history: object vertices at ticks 0 … h [m], (h+1, n, 3).
        controllers: all controllers at ticks 0 … T-1 [m], (T, K, 3).
        ticks: place of every measured training frame on the clock, fractional, (F,), increasing.
        points: measured points of these frames [m], (F, N, 3).
        visible: (F, N) bool.
    """

    history: Array
    controllers: Array
    ticks: Array
    points: Array
    visible: Array


@dataclass(frozen=True)
class FineTuneResult:
    """``phi`` (n, 2) and ``strengths`` by name of their column: what was found if it is ``kept``, else where it began;
    the inner validation error [m] before, and the least after; the 95 % interval of the difference.
    """

    phi: Array
    strengths: dict[str, float]
    error_before_m: float
    error_after_m: float
    gain_ci95_m: tuple[float, float]
    kept: bool
    steps: int


def fine_tune(
    model: WorldModel,
    phi: Array,
    recording: Recording,
    skin: Skin,
    config: FineTuneConfig,
    *,
    progress: Callable[[int, int, float], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> FineTuneResult:
    """Optimise Φ, and strengths from 0 on, on the recording's training frames; see the module's docstring.

    A recording without a frame (training ends within the network's history) leaves everything as it is.

    Args:
        model: whose weights are frozen; the shared columns of its Φ have limits.
        phi: where Φ starts, (n, 2).
        recording: what is approached.
        skin: how vertices carry its points.
        config: steps, segments, weights of the loss.
        progress: called after each step with (step, steps, loss).
        cancelled: asked before each step; true raises TrainingCancelled.
    """
    shared = model.shared_columns
    if unlimited := [one.name for one in shared if one.limits is None]:
        raise ValueError(f"no limits for the model's columns {', '.join(unlimited)}")
    limits = np.array([one.limits for one in shared], dtype=float).reshape(-1, 2)
    if not len(recording.ticks):
        still = dict.fromkeys((one.name for one in shared), 0.0)
        return FineTuneResult(np.array(phi, dtype=float), still, np.nan, np.nan, (np.nan, np.nan), False, 0)
    trainable = [parameter for parameter in model.parameters() if parameter.requires_grad]
    for parameter in trainable:
        parameter.requires_grad_(False)
    try:
        return _optimise(_Task(model, recording, skin, config), phi, limits, progress, cancelled)
    finally:
        for parameter in trainable:
            parameter.requires_grad_(True)


def _optimise(
    task: _Task,
    phi: Array,
    limits: Array,
    progress: Callable[[int, int, float], None] | None,
    cancelled: Callable[[], bool] | None,
) -> FineTuneResult:
    """Adam on Φ and the strengths until the inner validation stops improving."""
    model, config = task.model, task.config
    scale, local_count = model.norm.properties, len(PROPERTIES)
    start = torch.as_tensor(phi, dtype=torch.float32)
    start = torch.cat([start, start.new_zeros(len(start), len(limits))], dim=1)
    low, high = (torch.as_tensor(side, dtype=torch.float32) / scale[local_count:] for side in limits.T)
    path = task.rollout(start)
    before = best = task.validation_errors(path)
    best_phi, best_step, step = start, 0, 0
    local = torch.zeros_like(start[:, :local_count], requires_grad=True)
    shared = torch.zeros(len(limits), requires_grad=True)
    optimiser = torch.optim.Adam([local, shared], lr=config.learning_rate)
    while step < config.steps and task.segments:
        if cancelled is not None and cancelled():
            raise TrainingCancelled(step)
        optimiser.zero_grad()
        change = torch.cat([local, shared.expand(len(start), -1)], dim=1)
        loss = task.loss(path, start + change * scale)
        loss = loss + config.smoothness_weight * change.square().sum(dim=1).mean()
        loss.backward()  # type: ignore[no-untyped-call]  # torch's has no types
        torch.nn.utils.clip_grad_norm_([local, shared], 1.0)
        optimiser.step()
        with torch.no_grad():
            shared.clamp_(low, high)
        step += 1
        if progress is not None:
            progress(step, config.steps, loss.item())
        if step % CHECK_EVERY == 0 or step == config.steps:
            change = torch.cat([local, shared.expand(len(start), -1)], dim=1)
            candidate = (start + change * scale).detach()
            path = task.rollout(candidate)
            errors = task.validation_errors(path)
            if errors.mean() < best.mean():
                best, best_phi, best_step = errors, candidate, step
            elif step - best_step >= PATIENCE_CHECKS * CHECK_EVERY:
                break
    interval = _gain(before, best)
    kept = best_step > 0 and interval[0] > 0.0
    found = (best_phi if kept else start).double().numpy()
    names = [one.name for one in model.shared_columns]
    strengths = dict(zip(names, found[0, local_count:].tolist(), strict=True))
    return FineTuneResult(
        phi=found[:, :local_count].copy(),
        strengths=strengths,
        error_before_m=float(before.mean()),
        error_after_m=float(best.mean()),
        gain_ci95_m=interval,
        kept=kept,
        steps=step,
    )


def _gain(before: Array, after: Array) -> tuple[float, float]:
    """The 95 % interval [m] of what the errors of the same frames (F,) are smaller after; endless where the rollout
    before left the numbers and the one after did not.
    """
    if not np.isfinite(before).all():
        return (np.inf, np.inf) if np.isfinite(after).all() else (np.nan, np.nan)
    return paired_gain(before, after).ci95


class _Task:
    """The recording in single precision around its origin, its segments, its two losses."""

    def __init__(self, model: WorldModel, recording: Recording, skin: Skin, config: FineTuneConfig) -> None:
        spec = model.spec
        origin = graph_origin(spec, recording.history[-1])
        self.model, self.skin, self.config = model, skin, config
        last = int(np.ceil(recording.ticks[-1] - 1e-6)) + 1
        self.start = recording.history - origin
        controllers = recording.controllers[:last, spec.control_index] - origin
        self.driven = torch.as_tensor(controllers, dtype=torch.float32)[:, :, None]
        self.points = torch.as_tensor(recording.points - origin, dtype=torch.float32)
        self.visible = torch.as_tensor(recording.visible)
        self.left = np.clip(np.floor(recording.ticks + 1e-6).astype(np.int64), 0, max(last - 2, 0))
        self.part = torch.as_tensor(recording.ticks - self.left, dtype=torch.float32)
        self.scale = self._excursion()
        self.fitting = max(1, round((1.0 - config.validation_fraction) * len(self.left)))
        self.segments = self._segments(int(self.left[self.fitting - 1]))
        self.constants = model.edge_constants()
        self.engine = None if model.shared_columns else RolloutEngine(model)

    def _excursion(self) -> float:
        """s: root mean square distance [m] of the visible measured points from their own means."""
        seen = self.visible[..., None]
        mean = torch.where(seen, self.points, 0.0).sum(dim=0) / seen.sum(dim=0).clamp(min=1)
        moved = torch.where(seen, self.points - mean, 0.0).square().sum(dim=-1)
        return float((moved.sum() / seen.sum().clamp(min=1)).sqrt().clamp(min=1e-6))

    def _segments(self, last: int) -> list[int]:
        """First ticks of the segments: evenly over the fitting part, all of one length."""
        self.length = min(self.config.window, last - self.model.config.history)
        if self.length < 1:
            return []
        latest = last - self.length - self.model.config.history
        count = max(1, min(self.config.windows, latest + 1))
        return sorted({int(s) for s in np.linspace(0, latest, count).round()})

    def rollout(self, phi: Tensor) -> Tensor:
        """Open loop over the training frames, (T, V, 3)."""
        own = phi[:, : len(PROPERTIES)].numpy()
        engine = self.engine or RolloutEngine(self.model.at_strengths(self._strengths(phi)))
        return torch.from_numpy(engine.run(self.start, self.driven.numpy()[:, :, 0], own))

    def _strengths(self, phi: Tensor) -> dict[str, float]:
        """The shared columns of Φ by name."""
        names = (one.name for one in self.model.shared_columns)
        return dict(zip(names, phi[0, len(PROPERTIES) :].tolist(), strict=True))

    def validation_errors(self, path: Tensor) -> Array:
        """Mean distance [m] of visible points in each of the frames (F,) that the fit does not see and that show one;
        infinite if not a number; a zero where no frame shows a point.
        """
        held_out = slice(self.fitting, None) if self.fitting < len(self.left) else slice(None)
        n, seen = self.model.spec.object_count, self.visible[held_out]
        predicted = self._at_frames(path[:, :n], np.arange(len(self.left))[held_out], 0)
        distance = torch.linalg.vector_norm(predicted - self.points[held_out], dim=-1).double()
        shown = seen.any(dim=1)
        if not shown.any():
            return np.zeros(1)
        errors: Array = (torch.where(seen, distance, 0.0).sum(dim=1) / seen.sum(dim=1))[shown].numpy()
        return np.where(np.isfinite(errors), errors, np.inf)

    def loss(self, path: Tensor, phi: Tensor) -> Tensor:
        """Data terms over all segments."""
        frames, n = self.model.config.history + 1, self.model.spec.object_count
        rows = torch.as_tensor(self.segments)[None] + torch.arange(frames + self.length)[:, None]
        window = path[rows[:frames]].transpose(1, 2)
        driven = self.driven[rows, :, 0].transpose(1, 2)
        shared = phi[:, None].expand(-1, len(self.segments), -1)
        ticks = list(window[:, :n])
        ahead = driven[frames : frames + self.length]
        for following, turn in zip(ahead, turns_ahead(self.model.spec.frame, ahead), strict=True):
            moved = self.model.step(window, following, shared, self.constants, turn)
            ticks.append(moved[:n])
            window = torch.cat([window[1:], moved[None]])
        whole = torch.stack(ticks)
        terms = [self._compare(whole[:, :, b], first) for b, first in enumerate(self.segments)]
        seen = [term for term in terms if term is not None]
        return torch.stack(seen).mean() if seen else whole.sum() * 0.0

    def _compare(self, ticks: Tensor, first: int) -> Tensor | None:
        """Loss of one segment (S, n, 3) that starts at tick ``first``; None where no frame falls into it."""
        history, last = self.model.config.history, first + ticks.shape[0] - 1
        inside = np.nonzero((self.left >= first + history) & (self.left + 1 <= last))[0]
        if not len(inside):
            return None
        visible = self.visible[inside]
        predicted, measured = self._at_frames(ticks, inside, first), self.points[inside]
        squares = (predicted - measured).square().sum(dim=-1)
        count = visible.sum().clamp(min=1)
        loss = torch.where(visible, squares, 0.0).sum() / count / self.scale**2
        if self.config.chamfer_weight > 0.0:
            nearest = torch.cdist(measured, predicted).amin(dim=-1)
            chamfer = torch.where(visible, nearest, 0.0).sum() / count / self.scale
            loss = loss + self.config.chamfer_weight * chamfer
        return loss

    def _at_frames(self, ticks: Tensor, frames: Array, first: int) -> Tensor:
        """Tracked points (F, N, 3) at measured frames, linear between ticks."""
        left = torch.as_tensor(self.left[frames] - first)
        part = self.part[frames][:, None, None]
        right = (left + 1).clamp(max=ticks.shape[0] - 1)
        return self.skin.apply_torch((1.0 - part) * ticks[left] + part * ticks[right])
