"""Training the graph network on demonstration episodes (paper, section Model Training).

The loss (``physworld.worldmodel.loss``) is of a sub-sequence of τ steps, unrolled from a random frame t whose history
carries random-walk noise, so that training sees the kind of errors that a rollout makes; Φ carries noise too, so that
it can be fine-tuned later. With a τ of a few frames the network learns corrections that do not last: τ is long from the
first step. A running average of the weights is what is validated (open-loop
rollouts of whole held-out episodes) and returned; the best one wins; ``patience`` validations without a better one end
the training. On a CPU the same seed, data and settings give the same weights, and so does a run that was interrupted
and resumed from a checkpoint; on CUDA, where sums have no order of their own, they do up to rounding.

A slack rope or a body that snaps through has sub-sequences in which a gradient grows without end over the unrolled
frames. A step whose gradient is ``EXPLODED`` times the usual one, or no number, is left out and counted;
``MOST_LEFT_OUT`` in a row are a training that diverged: it ends, and what is returned is the best network before, if
any was better than the prior alone.

**While episodes still arrive** (``start_share`` below 1): the first share of the episodes by index is enough to begin.
Validation episodes, scales and prior come from it and stay. The others join in the order of their index at steps
that the settings alone decide, spread over the first ``JOIN_SHARE`` of the training, which waits for one that is not
there yet: the weights do not depend on when an episode arrived.
"""

from __future__ import annotations

import copy
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain
from typing import Any

import torch
from torch import Tensor

from physworld.worldmodel.dataset import Track, WindowSampler, measure_scales, split_tracks
from physworld.worldmodel.errors import (
    CheckpointMismatch,
    DatasetUnusable,
    TrainingCancelled,
    TrainingDiverged,
)
from physworld.worldmodel.loss import GraphedLoss, Loss, plain_loss
from physworld.worldmodel.model.config import TrainingConfig, WorldModelConfig
from physworld.worldmodel.model.features import Normalisation, Scales
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.inertia import one_step_residual
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.modes import measure_modes
from physworld.worldmodel.model.properties import PROPERTIES, PhiColumn
from physworld.worldmodel.priors.choose import choose, fit_priors, prior_error, spec_for
from physworld.worldmodel.priors.modal import ModalPrior
from physworld.worldmodel.priors.prior_step import framed_prior, prior_step
from physworld.worldmodel.rollout import mean_error, rollout_tracks

WARM_UP_SHARE = 0.1
JOIN_SHARE = 0.5
JOIN_BATCHES = 10
EXPLODED = 30.0  # times the usual gradient
MOST_LEFT_OUT = 10  # steps in a row
_FORGET = 0.1  # share of the usual gradient that the newest one makes
_GIVE = 1.5  # by which the usual gradient grows with each step left out: a training may become another one


@dataclass(frozen=True)
class TrainingResult:
    """The best averaged model; ``validation`` holds (step, open-loop error [m]); ``losses`` (step, loss).

    ``prior``: which one is under the network; ``prior_errors_m``: open-loop errors of those that were tried;
    ``steps``: taken, fewer than asked for where the patience ended; ``steps_left_out`` of them for an exploding
    gradient; ``diverged_at``: the step from which on it diverged, None where it did not; ``episodes``: trained or
    validated on.
    """

    model: WorldModel
    validation: list[tuple[int, float]]
    losses: list[tuple[int, float]]
    best_step: int
    best_error_m: float
    prior_error_m: float
    prior: str
    prior_errors_m: dict[str, float]
    static_error_m: float
    steps: int
    steps_left_out: int
    diverged_at: int | None
    episodes: int


@dataclass
class _Run:
    """Everything that changes while training; what a checkpoint holds, but for ``norm``, the model's scales on the CPU,
    and ``gradient``, which computes its losses.

    ``usual``: running norm of the gradient, 0 before the first; ``loss`` of the last step that was used, at first that
    of the prior alone; ``in_a_row`` and ``left_out``: steps left out, lately and in all.
    """

    model: WorldModel
    average: WorldModel
    optimiser: torch.optim.Adam
    generator: torch.Generator
    norm: Scales
    gradient: Loss
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


_FIGURES = (
    "step", "best_error_m", "best_step", "validation", "losses", "usual", "loss", "in_a_row", "left_out",
)  # fmt: skip


def train(
    tracks: Sequence[Track | Sequence[Track]],
    spec: GraphSpec,
    config: WorldModelConfig,
    training: TrainingConfig,
    *,
    columns: tuple[PhiColumn, ...] = PROPERTIES,
    total: int | None = None,
    later: Callable[[int], Track | Sequence[Track]] | None = None,
    checkpoint: bytes | None = None,
    save_checkpoint: Callable[[bytes], None] | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    validated: Callable[[int, float], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    device: str = "cpu",
    network: Callable[..., WorldModel] = WorldModel,
    start: WorldModel | None = None,
) -> TrainingResult:
    """Train on ``tracks``; see the module's docstring.

    Args:
        tracks: every episode, or the first :func:`first_episodes` of ``total`` when the others come ``later``; of each
            one track, or those of the parts of it that are learned from, perhaps none.
        spec: the graph.
        config: the network.
        training: steps, batches, rates, seed.
        columns: what the columns of the tracks' Φ stand for.
        total: how many episodes there will be; by default those of ``tracks``.
        later: gives an episode by its index, when it is there; raises TrainingCancelled while it waits.
        checkpoint: bytes that an earlier, interrupted run gave to ``save_checkpoint``.
        save_checkpoint: called every ``checkpoint_every`` steps.
        progress: called after each step with (step, steps, loss).
        validated: called after each validation with (step, open-loop error [m]).
        cancelled: asked before each step; true raises TrainingCancelled.
        device: of the network while it learns, "cpu" or "cuda:0"; data, priors and result are on the CPU.
        network: builds it from the arguments of :class:`WorldModel`.
        start: a model, perhaps of another body, whose weights it goes on from (:meth:`WorldModel.take`, which may
            raise NetworkMismatch); the first two validations are then of the prior alone and of these weights.

    Raises:
        DatasetUnusable: there is nothing to learn from.
        TrainingDiverged: gradients exploded before any network was better than the prior alone.
        TrainingCancelled, NetworkMismatch: see the arguments.
    """
    if not tracks:
        raise DatasetUnusable("no episode to train on")
    torch.set_num_threads(training.threads)
    total = len(tracks) if total is None else total
    first = first_episodes(total, training.start_share)
    if len(tracks) < (total if later is None else first):
        raise DatasetUnusable(f"{len(tracks)} of {total} episodes are here; the training begins with {first}")
    later = later or tracks.__getitem__
    known = [parts for episode in tracks[:first] if (parts := _parts(episode))]
    if not known:
        raise DatasetUnusable(f"the first {first} of {total} episodes have no part to train on")
    learned, judged = split_tracks(known, training.validation_fraction, training.seed)
    fitting, held_out = [*chain.from_iterable(learned)], [*chain.from_iterable(judged)]
    used = len(known)
    h = config.history
    positions, phis = [track.positions.numpy() for track in fitting], [track.phi.numpy() for track in fitting]
    priors = fit_priors(positions, phis, spec, config, training.prior, training.frame)
    graphs = {name: spec_for(name, spec, training.frame) for name in priors}
    prior_errors = {name: prior_error(prior, held_out, graphs[name], h) for name, prior in priors.items()}
    chosen = choose(prior_errors)
    prior, spec = priors[chosen], graphs[chosen]
    ahead = framed_prior(prior_step(prior, h), spec)
    scales = measure_scales(
        fitting,
        spec,
        lambda track: one_step_residual(ahead, track.positions, track.phi, spec.object_count, h),
    )
    modal = isinstance(prior, ModalPrior)
    modes = None if modal else measure_modes([track.positions for track in fitting], spec, h)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(training.seed)
        model = network(config, spec, scales, prior, columns, modes).to(device)
    run = _start(model, scales, training)
    identity = _identity(config, training, scales)
    identity |= {} if model.modes is None else {"mapped_modes": len(model.modes.shapes)}
    if checkpoint is not None:
        _restore(run, checkpoint, identity)
    if run.step == 0:
        _validate(run, held_out, validated)
        if start is not None:
            run.model.take(start)
            run.average.take(start)
            _validate(run, held_out, validated)
    joined = first
    sampler, diverged_at = WindowSampler(fitting), None
    while run.step < training.steps and not _out_of_patience(run, training):
        if cancelled is not None and cancelled():
            raise TrainingCancelled(run.step)
        present = episodes_at(run.step, first, total, training.steps)
        if present > joined:
            joining = [_parts(later(index)) for index in range(joined, present)]
            fitting += chain.from_iterable(joining)
            used += sum(map(bool, joining))
            sampler, joined = WindowSampler(fitting), present
        longest = max(sampler.lengths) - config.history - 1
        try:
            _train_step(run, sampler, training, min(training.look_ahead, longest))
        except TrainingDiverged as error:
            if run.best_step == 0:
                raise
            diverged_at = error.step
            break
        run.step += 1
        if run.step % training.validation_every == 0 or run.step == training.steps:
            run.losses.append((run.step, run.loss))
            _validate(run, held_out, validated)
        if save_checkpoint is not None and run.step % training.checkpoint_every == 0:
            save_checkpoint(_checkpoint(run, identity))
        if progress is not None:
            progress(run.step, training.steps, run.loss)
    run.average.load_state_dict(run.best_weights)
    return TrainingResult(
        model=run.average.cpu(),
        validation=run.validation,
        losses=run.losses,
        best_step=run.best_step,
        best_error_m=run.best_error_m,
        prior_error_m=run.validation[0][1],
        prior=chosen,
        prior_errors_m=prior_errors,
        static_error_m=mean_error([_static(track, config.history) for track in held_out], held_out, spec),
        steps=run.step,
        steps_left_out=run.left_out,
        diverged_at=diverged_at,
        episodes=used,
    )


def first_episodes(total: int, start_share: float) -> int:
    """How many of ``total`` episodes a training begins with: at least two, where there are two."""
    return max(math.ceil(start_share * total - 1e-9), min(2, total))


def episodes_at(step: int, first: int, total: int, steps: int) -> int:
    """How many episodes take part from ``step`` of ``steps`` on; they join in ``JOIN_BATCHES`` batches.

    Args:
        step: of the training.
        first: episodes at the start.
        total: episodes in the end.
        steps: of the whole training.
    """
    share = min(1.0, step / max(1.0, JOIN_SHARE * steps))
    return first + math.floor((total - first) * math.floor(share * JOIN_BATCHES) / JOIN_BATCHES)


def _parts(episode: Track | Sequence[Track]) -> Sequence[Track]:
    """What is learned from of an episode."""
    return [episode] if isinstance(episode, Track) else episode


def open_loop_error(model: WorldModel, tracks: list[Track]) -> float:
    """Mean distance [m] of predicted object vertices over whole episodes, after the given first h + 1
    frames.
    """
    return mean_error(rollout_tracks(model, tracks), tracks, model.spec)


def _start(model: WorldModel, scales: Normalisation, training: TrainingConfig) -> _Run:
    generator = torch.Generator().manual_seed(training.seed)
    optimiser = torch.optim.Adam(model.parameters(), lr=training.learning_rate)
    gradient = GraphedLoss() if GraphedLoss.fits(model) else plain_loss
    return _Run(model, copy.deepcopy(model), optimiser, generator, Scales(scales, model.spec), gradient)


def _train_step(run: _Run, sampler: WindowSampler, training: TrainingConfig, look_ahead: int) -> None:
    """One optimiser step, or none where the gradient explodes. Raises TrainingDiverged."""
    model, h = run.model, run.model.config.history
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
    if not _usable(run, loss.item(), size.item()):
        return
    run.optimiser.step()
    keep = min(training.average_decay, (1.0 + run.step) / (10.0 + run.step))
    with torch.no_grad():
        torch._foreach_lerp_(list(run.average.parameters()), list(model.parameters()), 1.0 - keep)


def _usable(run: _Run, loss: float, norm: float) -> bool:
    """Whether a step's gradient is of the usual size; keeps count. Raises TrainingDiverged."""
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


def _validate(run: _Run, held_out: list[Track], validated: Callable[[int, float], None] | None) -> None:
    error = open_loop_error(run.average, held_out)
    run.validation.append((run.step, error))
    if validated is not None:
        validated(run.step, error)
    if error < run.best_error_m or not run.best_weights:
        run.best_error_m, run.best_step = error, run.step
        run.best_weights = {name: value.clone() for name, value in run.average.state_dict().items()}


def _out_of_patience(run: _Run, training: TrainingConfig) -> bool:
    """Whether the last ``patience`` validations brought nothing better."""
    since = sum(step > run.best_step for step, _ in run.validation)
    return 0 < training.patience <= since


def _static(track: Track, history: int) -> Tensor:
    """The last known frame for ever."""
    x = track.positions
    return torch.cat([x[: history + 1], x[history].expand(x.shape[0] - history - 1, -1, -1)])


def _identity(config: WorldModelConfig, training: TrainingConfig, scales: Normalisation) -> dict[str, Any]:
    """What a checkpoint must agree with: settings, the data's scales as their fingerprint, what it holds."""
    held = {"config": asdict(config), "training": asdict(training), "scales": asdict(scales)}
    return held | {"figures": _FIGURES}


def _checkpoint(run: _Run, identity: dict[str, Any]) -> bytes:
    held = {
        "identity": repr(identity),
        "model": run.model.state_dict(),
        "average": run.average.state_dict(),
        "optimiser": run.optimiser.state_dict(),
        "generator": run.generator.get_state(),
        "best_weights": run.best_weights,
        "figures": {name: getattr(run, name) for name in _FIGURES},
    }
    buffer = io.BytesIO()
    torch.save(held, buffer)
    return buffer.getvalue()


def _restore(run: _Run, checkpoint: bytes, identity: dict[str, Any]) -> None:
    held = torch.load(io.BytesIO(checkpoint), map_location="cpu", weights_only=True)
    if held["identity"] != repr(identity):
        raise CheckpointMismatch(f"checkpoint of {held['identity']}, but this run is {identity!r}")
    run.model.load_state_dict(held["model"])
    run.average.load_state_dict(held["average"])
    run.optimiser.load_state_dict(held["optimiser"])
    run.generator.set_state(held["generator"])
    run.best_weights = held["best_weights"]
    for name, value in held["figures"].items():
        setattr(run, name, value)
