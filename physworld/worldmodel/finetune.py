"""Fine-tuning of Φ on a recording, weights frozen (paper, section Physical Property Fine-Tuning).

The open-loop rollout over the recording's fitting frames is cut into segments of ``window`` steps. Each
step of the optimisation unrolls all segments at once (a batch) from the rollout's own states and compares
the skinned tracked points with the visible measured ones:

    loss = MSE / s² + chamfer_weight · Chamfer / s + smoothness_weight · ‖(Φ - Φ_start) / σ_properties‖²

where s is the root-mean-square excursion of the measured points and Chamfer goes from the measured points
to the nearest predicted ones. The states are refreshed by a new rollout each time the inner validation is
made. That one, the open-loop error on the last share of the *training* frames, decides when to stop and
whether the result is kept at all: a Φ that does not beat the calibrated one there is thrown away.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from physworld.worldmodel.config import FineTuneConfig
from physworld.worldmodel.dataset import graph_origin
from physworld.worldmodel.engine import RolloutEngine
from physworld.worldmodel.errors import TrainingCancelled
from physworld.worldmodel.model import WorldModel
from physworld.worldmodel.skinning import Skin

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

    history: np.ndarray
    controllers: np.ndarray
    ticks: np.ndarray
    points: np.ndarray
    visible: np.ndarray


@dataclass(frozen=True)
class FineTuneResult:
    """``phi`` (n, 2); the inner validation error [m] before and after; whether the new Φ was kept."""

    phi: np.ndarray
    error_before_m: float
    error_after_m: float
    kept: bool
    steps: int


def fine_tune(
    model: WorldModel,
    phi: np.ndarray,
    recording: Recording,
    skin: Skin,
    config: FineTuneConfig,
    *,
    progress: Callable[[int, int, float], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> FineTuneResult:
    """Optimise ``phi`` (n, 2) on the recording's training frames; see the module's docstring."""
    trainable = [parameter for parameter in model.parameters() if parameter.requires_grad]
    for parameter in trainable:
        parameter.requires_grad_(False)
    try:
        return _optimise(_Task(model, recording, skin, config), phi, progress, cancelled)
    finally:
        for parameter in trainable:
            parameter.requires_grad_(True)


def _optimise(
    task: _Task,
    phi: np.ndarray,
    progress: Callable[[int, int, float], None] | None,
    cancelled: Callable[[], bool] | None,
) -> FineTuneResult:
    """Adam on Φ until the inner validation stops improving."""
    model, config = task.model, task.config
    start = torch.as_tensor(phi, dtype=torch.float32)
    path = task.rollout(start)
    before = best = task.validation_error(path)
    best_phi, best_step, step = start, 0, 0
    change = torch.zeros_like(start, requires_grad=True)
    optimiser = torch.optim.Adam([change], lr=config.learning_rate)
    while step < config.steps and task.segments:
        if cancelled is not None and cancelled():
            raise TrainingCancelled(step)
        optimiser.zero_grad()
        loss = task.loss(path, start + change * model.norm.properties)
        loss = loss + config.smoothness_weight * change.square().sum(dim=1).mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_([change], 1.0)
        optimiser.step()
        step += 1
        if progress is not None:
            progress(step, config.steps, loss.item())
        if step % CHECK_EVERY == 0 or step == config.steps:
            candidate = (start + change * model.norm.properties).detach()
            path = task.rollout(candidate)
            error = task.validation_error(path)
            if error < best:
                best, best_phi, best_step = error, candidate, step
            elif step - best_step >= PATIENCE_CHECKS * CHECK_EVERY:
                break
    return FineTuneResult(best_phi.double().numpy(), before, best, best_step > 0, step)


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
        moved = torch.where(self.visible[..., None], self.points - self.points.mean(dim=0), 0.0)
        self.scale = float(moved.square().sum(dim=-1).mean().sqrt().clamp(min=1e-6))
        self.fitting = max(1, round((1.0 - config.validation_fraction) * len(self.left)))
        self.segments = self._segments(int(self.left[self.fitting - 1]))
        self.constants = model.edge_constants()
        self.engine = RolloutEngine(model)

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
        return torch.from_numpy(self.engine.run(self.start, self.driven.numpy()[:, :, 0], phi.numpy()))

    def validation_error(self, path: Tensor) -> float:
        """Mean distance [m] of visible points in the frames that the fit does not see; infinite if not a
        number.
        """
        held_out = slice(self.fitting, None) if self.fitting < len(self.left) else slice(None)
        n = self.model.spec.object_count
        predicted = self._at_frames(path[:, :n], np.arange(len(self.left))[held_out], 0)
        distance = torch.linalg.vector_norm(predicted - self.points[held_out], dim=-1)[self.visible[held_out]]
        error = float(distance.double().mean()) if distance.numel() else 0.0
        return error if np.isfinite(error) else np.inf

    def loss(self, path: Tensor, phi: Tensor) -> Tensor:
        """Data terms over all segments."""
        frames, n = self.model.config.history + 1, self.model.spec.object_count
        rows = torch.as_tensor(self.segments)[None] + torch.arange(frames + self.length)[:, None]
        window = path[rows[:frames]].transpose(1, 2)
        driven = self.driven[rows, :, 0].transpose(1, 2)
        shared = phi[:, None].expand(-1, len(self.segments), -1)
        ticks = list(window[:, :n])
        for i in range(self.length):
            moved = self.model.step(window, driven[frames + i], shared, self.constants)
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

    def _at_frames(self, ticks: Tensor, frames: np.ndarray, first: int) -> Tensor:
        """Tracked points (F, N, 3) at measured frames, linear between ticks."""
        left = torch.as_tensor(self.left[frames] - first)
        part = self.part[frames][:, None, None]
        right = (left + 1).clamp(max=ticks.shape[0] - 1)
        return self.skin.apply_torch((1.0 - part) * ticks[left] + part * ticks[right])
