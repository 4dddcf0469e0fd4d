"""One network while it trains: its optimiser steps, its validations, and the checkpoint that holds both.

:mod:`physworld.worldmodel.training` says what the episodes are, and which networks are trained on them.
"""

from __future__ import annotations

import copy
import io
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch import Tensor

from physworld.worldmodel.dataset import Track, WindowSampler
from physworld.worldmodel.errors import TrainingDiverged
from physworld.worldmodel.loss import GraphedLoss, Loss, plain_loss
from physworld.worldmodel.model.config import TrainingConfig
from physworld.worldmodel.model.features import Normalisation, Scales
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.rollout import mean_error, rollout_tracks

WARM_UP_SHARE = 0.1
EXPLODED = 30.0  # times the usual gradient
MOST_LEFT_OUT = 10  # steps in a row
_FORGET = 0.1  # share of the usual gradient that the newest one makes
_GIVE = 1.5  # by which the usual gradient grows with each step left out: a training may become another one


@dataclass
class Run:
    """Everything that changes while training; what a checkpoint holds, but for ``norm``, the model's scales on the CPU,
    ``gradient``, which computes its losses, ``prior``, which is under the network, and ``scales``.

    ``usual``: running norm of the gradient, 0 before the first; ``loss`` of the last step that was used, at first that
    of the prior alone; ``in_a_row`` and ``left_out``: steps left out, lately and in all; ``diverged_at``: the step from
    which on it diverged; ``heats_m``: what each network that competed had come to err when this one was chosen [m].
    """

    model: WorldModel
    average: WorldModel
    optimiser: torch.optim.Adam
    generator: torch.Generator
    norm: Scales
    gradient: Loss
    scales: Normalisation
    prior: str
    step: int = 0
    best_error_m: float = math.inf
    best_step: int = 0
    best_weights: dict[str, Tensor] = field(default_factory=dict)
    validation: list[tuple[int, float]] = field(default_factory=list)
    losses: list[tuple[int, float]] = field(default_factory=list)
    usual: float = 0.0
    loss: float = 1.0
    in_a_row: int = 0
    left_out: int = 0
    diverged_at: int | None = None
    heats_m: dict[str, float] = field(default_factory=dict)


FIGURES = (
    "step", "best_error_m", "best_step", "validation", "losses", "usual", "loss", "in_a_row", "left_out", "heats_m",
)  # fmt: skip


def begin(model: WorldModel, scales: Normalisation, prior: str, training: TrainingConfig) -> Run:
    """A run before its first step.

    Args:
        model: on the device where it trains.
        scales: of its inputs and outputs.
        prior: the name of the one under it.
        training: rates and seed.
    """
    generator = torch.Generator().manual_seed(training.seed)
    optimiser = torch.optim.Adam(model.parameters(), lr=training.learning_rate)
    gradient = GraphedLoss() if GraphedLoss.fits(model) else plain_loss
    norm = Scales(scales, model.spec)
    return Run(model, copy.deepcopy(model), optimiser, generator, norm, gradient, scales, prior)


def take_step(run: Run, sampler: WindowSampler, training: TrainingConfig) -> None:
    """One optimiser step, or none where the gradient explodes; it counts either way.

    Raises:
        TrainingDiverged: too many exploded in a row.
    """
    model, h = run.model, run.model.config.history
    look_ahead = min(training.look_ahead, max(sampler.lengths) - h - 1)
    batch = sampler.draw(h + 1 + look_ahead, training.batch_size, run.generator)
    n, norm = model.spec.object_count, run.norm
    window = _with_noise(batch.positions[: h + 1], n, training.noise_history * norm.change, run.generator)
    noise = torch.randn(batch.phi.shape, generator=run.generator) * norm.properties
    phi = batch.phi + training.noise_properties * noise
    share = run.step / training.steps
    floor = training.learning_rate_floor
    warm = min(1.0, (run.step + 1) / (WARM_UP_SHARE * training.steps))
    rate = warm * training.learning_rate * (floor + (1.0 - floor) * 0.5 * (1.0 + math.cos(math.pi * share)))
    for group in run.optimiser.param_groups:
        group["lr"] = rate
    loss = run.gradient(model, window, batch.positions[h + 1 :], phi)
    size = torch.nn.utils.clip_grad_norm_(model.parameters(), training.gradient_clip)
    if usable(run, loss.item(), size.item()):
        run.optimiser.step()
        keep = min(training.average_decay, (1.0 + run.step) / (10.0 + run.step))
        with torch.no_grad():
            torch._foreach_lerp_(list(run.average.parameters()), list(model.parameters()), 1.0 - keep)
    run.step += 1


def usable(run: Run, loss: float, norm: float) -> bool:
    """Whether a step's gradient is of the usual size; keeps count.

    Args:
        run: whose step it is.
        loss: of the step.
        norm: of its gradient.

    Raises:
        TrainingDiverged: too many were not, in a row.
    """
    usual = run.usual or norm
    if math.isfinite(loss) and math.isfinite(norm) and norm <= EXPLODED * usual:
        run.usual = (1.0 - _FORGET) * usual + _FORGET * norm
        run.loss, run.in_a_row = loss, 0
        return True
    run.usual *= _GIVE
    run.in_a_row += 1
    run.left_out += 1
    if run.in_a_row >= MOST_LEFT_OUT:
        raise TrainingDiverged(run.step + 1 - run.in_a_row, loss)
    return False


def _with_noise(window: Tensor, n: int, scale: Tensor, generator: torch.Generator) -> Tensor:
    """A random walk on the object vertices' history (h+1, V, B, 3) whose last velocity error has that scale."""
    steps = window.shape[0] - 1
    kicks = torch.randn((steps, n, *window.shape[2:]), generator=generator) * (scale / math.sqrt(steps))
    walk = kicks.cumsum(dim=0).cumsum(dim=0)
    noisy = window.clone()
    noisy[1:, :n] += walk
    return noisy


def open_loop_error(model: WorldModel, tracks: list[Track]) -> float:
    """Mean distance [m] of predicted object vertices over whole episodes, after the given first h + 1
    frames.
    """
    return mean_error(rollout_tracks(model, tracks), tracks, model.spec)


def validate(run: Run, held_out: list[Track], validated: Callable[[int, float], None] | None) -> None:
    """Judge the average weights on whole episodes, and keep them where they are the best so far.

    Args:
        run: whose weights are judged.
        held_out: what nothing else is learned from.
        validated: told (step, error [m]).
    """
    error = open_loop_error(run.average, held_out)
    run.validation.append((run.step, error))
    if validated is not None:
        validated(run.step, error)
    if error < run.best_error_m or not run.best_weights:
        run.best_error_m, run.best_step = error, run.step
        run.best_weights = {name: value.clone() for name, value in run.average.state_dict().items()}


def out_of_patience(run: Run, training: TrainingConfig) -> bool:
    """Whether the last ``patience`` validations brought nothing better."""
    since = sum(step > run.best_step for step, _ in run.validation)
    return 0 < training.patience <= since


def identity_of(run: Run, training: TrainingConfig) -> str:
    """What a checkpoint must agree with: settings, the data's scales as their fingerprint, what it holds."""
    modes = run.model.modes
    held: dict[str, Any] = {
        "config": asdict(run.model.config),
        "training": asdict(training),
        "scales": asdict(run.scales),
        "prior": run.prior,
        "mapped_modes": 0 if modes is None else len(modes.shapes),
        "figures": FIGURES,
    }
    return repr(held)


def checkpoint_of(run: Run, training: TrainingConfig) -> bytes:
    """Everything that a training goes on from."""
    held = {
        "identity": identity_of(run, training),
        "model": run.model.state_dict(),
        "average": run.average.state_dict(),
        "optimiser": run.optimiser.state_dict(),
        "generator": run.generator.get_state(),
        "best_weights": run.best_weights,
        "figures": {name: getattr(run, name) for name in FIGURES},
    }
    buffer = io.BytesIO()
    torch.save(held, buffer)
    return buffer.getvalue()


def opened(checkpoint: bytes) -> dict[str, Any]:
    """The parts of a checkpoint; ``identity`` says what it is of."""
    held: dict[str, Any] = torch.load(io.BytesIO(checkpoint), map_location="cpu", weights_only=True)
    return held


def restore(run: Run, held: dict[str, Any]) -> None:
    """Go on from the parts of a checkpoint of the same identity."""
    run.model.load_state_dict(held["model"])
    run.average.load_state_dict(held["average"])
    run.optimiser.load_state_dict(held["optimiser"])
    run.generator.set_state(held["generator"])
    run.best_weights = held["best_weights"]
    for name, value in held["figures"].items():
        setattr(run, name, value)
