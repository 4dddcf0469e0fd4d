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

**Which prior is under it** is for a rope decided by the networks: what a prior errs alone does not say what is left for
a network on it. Where the chain and a modal prior both can be made, a network on either trains for the first
``HEAT_SHARE`` of the steps, by the schedule of the whole training; the one that then errs less on validation goes on.

**While episodes still arrive** (``start_share`` below 1): the first share of the episodes by index is enough to begin.
Validation episodes, scales and prior come from it and stay. The others join in the order of their index at steps
that the settings alone decide, spread over the first ``JOIN_SHARE`` of the training, which waits for one that is not
there yet: the weights do not depend on when an episode arrived.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
from physworld.worldmodel.model.config import TrainingConfig, WorldModelConfig
from physworld.worldmodel.model.graph import GraphSpec
from physworld.worldmodel.model.inertia import one_step_residual
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.modes import measure_modes
from physworld.worldmodel.model.properties import PROPERTIES, PhiColumn
from physworld.worldmodel.priors.choose import choose, contenders, fit_priors, prior_error, spec_for
from physworld.worldmodel.priors.modal import ModalPrior
from physworld.worldmodel.priors.prior_step import framed_prior, prior_step
from physworld.worldmodel.rollout import mean_error
from physworld.worldmodel.training_run import (
    Run,
    begin,
    checkpoint_of,
    identity_of,
    opened,
    out_of_patience,
    restore,
    take_step,
    validate,
)

HEAT_SHARE = 0.125  # of the steps
JOIN_SHARE = 0.5
JOIN_BATCHES = 10


@dataclass(frozen=True)
class TrainingResult:
    """The best averaged model; ``validation`` holds (step, open-loop error [m]); ``losses`` (step, loss).

    ``prior``: which one is under the network; ``prior_errors_m``: open-loop errors of those that were tried, alone;
    ``heats_m``: of the networks that competed, by prior, when one was chosen (infinite: diverged), else empty;
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
    heats_m: dict[str, float]
    static_error_m: float
    steps: int
    steps_left_out: int
    diverged_at: int | None
    episodes: int


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
        save_checkpoint: called once it is decided which network goes on, then every ``checkpoint_every`` steps.
        progress: called after each step with (steps done, steps in all, loss), those of a network that is given up too.
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
    known = [parts for episode in tracks[:first] if (parts := _parts(episode))]
    if not known:
        raise DatasetUnusable(f"the first {first} of {total} episodes have no part to train on")
    learned, judged = split_tracks(known, training.validation_fraction, training.seed)
    fitting, held_out = [*chain.from_iterable(learned)], [*chain.from_iterable(judged)]
    h = config.history
    positions, phis = [track.positions.numpy() for track in fitting], [track.phi.numpy() for track in fitting]
    priors = fit_priors(positions, phis, spec, config, training.prior, training.frame)
    graphs = {name: spec_for(name, spec, training.frame) for name in priors}
    prior_errors = {name: prior_error(prior, held_out, graphs[name], h) for name, prior in priors.items()}

    def run_of(name: str) -> Run:
        """Of the network on the prior of that name, before its first step."""
        prior, graph = priors[name], graphs[name]
        ahead = framed_prior(prior_step(prior, h), graph)
        scales = measure_scales(
            fitting,
            graph,
            lambda track: one_step_residual(ahead, track.positions, track.phi, graph.object_count, h),
        )
        modal = isinstance(prior, ModalPrior)
        modes = None if modal else measure_modes([track.positions for track in fitting], graph, h)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(training.seed)
            model = network(config, graph, scales, prior, columns, modes).to(device)
        return begin(model, scales, name, training)

    heat = math.floor(HEAT_SHARE * training.steps)
    names = contenders(prior_errors) if heat > 0 else [choose(prior_errors)]
    runs = [run_of(name) for name in names]
    feed = _Feed(fitting, len(known), first, total, training.steps, later or tracks.__getitem__)
    loop = _Loop(training, feed, held_out, progress, validated, cancelled, lost=heat * (len(runs) - 1))
    if checkpoint is not None:
        run = _resumed(runs, opened(checkpoint), training)
        loop.before = loop.lost
    else:
        for run in runs:
            loop.begin(run, start)
        if len(runs) > 1:
            run = loop.winner(runs, heat)
            if save_checkpoint is not None:
                save_checkpoint(checkpoint_of(run, training))
    if run.diverged_at is None:
        loop.advance(run, training.steps, save_checkpoint)
    run.average.load_state_dict(run.best_weights)
    graph = graphs[run.prior]
    return TrainingResult(
        model=run.average.cpu(),
        validation=run.validation,
        losses=run.losses,
        best_step=run.best_step,
        best_error_m=run.best_error_m,
        prior_error_m=run.validation[0][1],
        prior=run.prior,
        prior_errors_m=prior_errors,
        heats_m=run.heats_m,
        static_error_m=mean_error([_static(track, config.history) for track in held_out], held_out, graph),
        steps=run.step,
        steps_left_out=run.left_out,
        diverged_at=run.diverged_at,
        episodes=feed.used,
    )


@dataclass
class _Feed:
    """Windows of the episodes that take part, more of them as the training goes on.

    Attributes:
        tracks: of the episodes that have joined, in the order of their index.
        used: episodes with something to learn from or to be validated on.
        first, total, steps: see :func:`episodes_at`.
        later: gives an episode by its index.
    """

    tracks: list[Track]
    used: int
    first: int
    total: int
    steps: int
    later: Callable[[int], Track | Sequence[Track]]

    def __post_init__(self) -> None:
        self._ends = {self.first: len(self.tracks)}  # tracks by the number of episodes that have joined
        self._latest = self.first, WindowSampler(self.tracks)

    def at(self, step: int) -> WindowSampler:
        """Of the episodes of that step."""
        present = episodes_at(step, self.first, self.total, self.steps)
        if present not in self._ends:
            joining = [_parts(self.later(index)) for index in range(max(self._ends), present)]
            self.tracks += chain.from_iterable(joining)
            self.used += sum(map(bool, joining))
            self._ends[present] = len(self.tracks)
        if present != self._latest[0]:
            self._latest = present, WindowSampler(self.tracks[: self._ends[present]])
        return self._latest[1]


@dataclass
class _Loop:
    """What every network's training shares; the callbacks are those of :func:`train`.

    ``before``: steps that other networks took until the present one began; ``lost``: steps of those given up, in all.
    """

    training: TrainingConfig
    feed: _Feed
    held_out: list[Track]
    progress: Callable[[int, int, float], None] | None
    validated: Callable[[int, float], None] | None
    cancelled: Callable[[], bool] | None
    before: int = 0
    lost: int = 0

    def begin(self, run: Run, start: WorldModel | None) -> None:
        """Judge the prior alone, and the weights that it goes on from."""
        validate(run, self.held_out, self.validated)
        if start is not None:
            run.model.take(start)
            run.average.take(start)
            validate(run, self.held_out, self.validated)

    def advance(self, run: Run, last: int, save: Callable[[bytes], None] | None = None) -> None:
        """Train to the step ``last``, or as far as patience and gradients allow."""
        training = self.training
        while run.step < last and not out_of_patience(run, training):
            if self.cancelled is not None and self.cancelled():
                raise TrainingCancelled(run.step)
            try:
                take_step(run, self.feed.at(run.step), training)
            except TrainingDiverged as error:
                if run.best_step == 0:
                    raise
                run.diverged_at = error.step
                return
            if run.step % training.validation_every == 0 or run.step == last:
                run.losses.append((run.step, run.loss))
                validate(run, self.held_out, self.validated)
            if save is not None and run.step % training.checkpoint_every == 0:
                save(checkpoint_of(run, training))
            if self.progress is not None:
                self.progress(self.before + run.step, training.steps + self.lost, run.loss)

    def winner(self, runs: list[Run], heat: int) -> Run:
        """The one of ``runs`` that errs least after ``heat`` steps; it has taken them.

        Raises:
            TrainingDiverged: all of them did.
        """
        heats: dict[str, float] = {}
        diverged: list[TrainingDiverged] = []
        for run in runs:
            try:
                self.advance(run, heat)
                heats[run.prior] = run.best_error_m
            except TrainingDiverged as error:
                heats[run.prior] = math.inf
                diverged.append(error)
            self.before += heat
        self.before = self.lost
        if len(diverged) == len(runs):
            raise diverged[0]
        best = min(runs, key=lambda run: heats[run.prior])
        best.heats_m = heats
        return best


def _resumed(runs: list[Run], held: dict[str, Any], training: TrainingConfig) -> Run:
    """The one of ``runs`` that the parts of a checkpoint are of, going on from it."""
    identities = [identity_of(run, training) for run in runs]
    if held["identity"] not in identities:
        raise CheckpointMismatch(f"checkpoint of {held['identity']}, but this run is {identities[0]}")
    run = runs[identities.index(held["identity"])]
    restore(run, held)
    return run


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


def _static(track: Track, history: int) -> Tensor:
    """The last known frame for ever."""
    x = track.positions
    return torch.cat([x[: history + 1], x[history].expand(x.shape[0] - history - 1, -1, -1)])
