"""The search for a motion that tells models apart: see :mod:`physworld.trace.experiment`.

Every motion costs one simulation a rival, and one more for every number that a refit would change. The plain
difference of two predictions is an upper bound of the one after refits, so only motions whose plain difference beats
the best so far are looked at more closely.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from physworld.arrays import Array
from physworld.demonstrate.limits import MotionLimits, limits_of
from physworld.estimation.simulations import Drive, Job, Simulations
from physworld.estimation.unknowns import at
from physworld.experiments.probing import COORDINATES, Motion, Probe, motion_of, nudged, random_probe
from physworld.experiments.rivals import Rival, reconciled, refit_of
from physworld.scene import Scene
from physworld.twin.twin import Twin

STAGE = "experiment"
NUMERICS_AMPLITUDE = 3.0  # deviation of the solver's own error, over the change by finer cells
_CONTROL_RATE_HZ = 100.0  # control points are given, and predictions made, at least this often
_ROUNDS = 2  # Gauss-Newton steps of the confirmation
_SHARES = (1.0, 0.3)  # of such a step, tried together


@dataclass(frozen=True)
class ExperimentConfig:
    """Settings.

    Attributes:
        draws: random motions, over all families.
        refinements: neighbours of the best that are tried.
        contenders: random motions whose refitted difference is computed, at most.
        simulations: budget.
        longest_s: duration of the experiment, at most; else as long as the recording.
        enough_sigmas: separation that settles the question.
        seed: everything random follows from it.
    """

    draws: int = 14
    refinements: int = 6
    contenders: int = 3
    simulations: int = 80
    longest_s: float = 3.0
    enough_sigmas: float = 5.0
    seed: int = 0


@dataclass(frozen=True)
class Tried:
    """A motion with every rival's prediction (T, N, 3), its plain separation and that after refits (None: open)."""

    probe: Probe
    motion: Motion
    tracks: tuple[Array, ...]
    plain: float
    refitted: float | None = None


class Search:
    """State of one search.

    Args:
        scene: the recording, whose reach and speed bound the motions.
        rivals: models that a motion shall separate; the first one's twin sets the grips' start.
        sigma: deviation of the measurement per axis [m].
        finer: the first rival's twin on finer cells; None: without.
        cost: of a twin on the recording, after which the rivals' properties are reconciled; None: they are taken as
            they are.
        config: motions to try and simulations to spend.
        simulations: that run the motions and count them.
    """

    def __init__(
        self,
        scene: Scene,
        rivals: list[Rival],
        sigma: float,
        finer: Twin | None,
        cost: Callable[[Twin], float] | None,
        config: ExperimentConfig,
        simulations: Simulations,
    ) -> None:
        self._simulations, self._before, self.tried = simulations, simulations.count, 0
        self.rivals = [replace(rival, twin=from_rest(rival.twin)) for rival in reconciled(rivals, cost)]
        self.finer = None if finer is None else from_rest(_refinement_of(rivals[0].twin, finer))
        self.sigma, self.config = sigma, config
        self.limits: MotionLimits = limits_of(scene, rivals[0].twin)
        self.pose = rivals[0].twin.controllers_start
        self.frame_times, self.control_times = clock_of(scene, config.longest_s)

    @property
    def count(self) -> int:
        """Simulations of this search so far."""
        return self._simulations.count - self._before

    def best(self) -> Tried | None:
        """The best motion found within the budget; None where no motion could be simulated."""
        config, generator = self.config, np.random.default_rng(self.config.seed)
        drawn = []
        for probe in drawn_probes(self.limits, config.draws, generator):
            found = self._try(probe)
            if found is not None:
                drawn.append(found)
        drawn.sort(key=lambda t: -t.plain)
        best: Tried | None = None
        for candidate in drawn[: config.contenders]:
            if best is None or candidate.plain > (best.refitted or 0.0):
                best = _better(best, self._refitted(candidate, forced=best is None))
        for step in range(config.refinements):
            if best is None:
                break
            size = 0.35 * 0.75**step
            near = self._try(nudged(best.probe, size, generator))
            if near is not None and near.plain > (best.refitted or 0.0):
                best = _better(best, self._refitted(near))
        if best is None or (best.refitted or 0.0) < config.enough_sigmas:
            return best
        return self.confirmed(best)

    def _try(self, probe: Probe) -> Tried | None:
        """A motion's predictions; None where a rival's run fails or the budget is spent."""
        if self.count + len(self.rivals) > self.config.simulations:
            return None
        motion = motion_of(probe, self.pose, self.limits, self.control_times)
        found = self._simulate(motion, [rival.twin for rival in self.rivals])
        self.tried += 1
        tracks = tuple(t for t in found if t is not None)
        if len(tracks) < len(self.rivals):
            return None
        plain = min(
            float(np.linalg.norm(a - b)) / self.sigma for k, a in enumerate(tracks) for b in tracks[:k]
        )
        return Tried(probe, motion, tracks, plain)

    def _refitted(self, tried: Tried, forced: bool = False) -> Tried | None:
        """The separation after refits; None where the budget is spent (``forced``: never) or a run fails."""
        cost = sum(len(rival.unknowns) for rival in self.rivals) + 1
        if self.count + cost > self.config.simulations and not forced:
            return None
        found = [self._slopes(tried, k, rival) for k, rival in enumerate(self.rivals)]
        numerics = self._numerics(tried)
        slopes = [slope for slope in found if slope is not None]
        if numerics is None or len(slopes) < len(found):
            return None
        least = np.inf
        for a, b in permutations(range(len(self.rivals)), 2):
            gap = (tried.tracks[a] - tried.tracks[b]).reshape(-1) / self.sigma
            known, offset = _known(self.rivals[b], numerics.shape[1])
            least = min(least, refit_of(gap, np.hstack([slopes[b], numerics]), known, offset)[1])
        return replace(tried, refitted=least)

    def confirmed(self, tried: Tried) -> Tried:
        """The separation with the full simulator: each rival refitted to what each other predicts."""
        least = tried.refitted or 0.0
        numerics = self._numerics(tried)
        if numerics is None:
            return replace(tried, refitted=0.0)
        for a, b in permutations(range(len(self.rivals)), 2):
            least = min(least, self._imitated(tried, a, b, numerics))
        return replace(tried, refitted=least)

    def _imitated(self, tried: Tried, truth: int, number: int, numerics: Array) -> float:
        """What is left of the prediction of ``truth`` after Gauss-Newton steps of the rival ``number``."""
        rival, tracks = self.rivals[number], tried.tracks[number]
        left = self._left(rival, tried.tracks[truth], tracks, numerics)
        for _ in range(_ROUNDS):
            slope = self._slopes(replace(tried, tracks=(tracks,)), 0, rival)
            if slope is None:
                break
            gap = (tried.tracks[truth] - tracks).reshape(-1) / self.sigma
            known, offset = _known(rival, numerics.shape[1])
            change, _ = refit_of(gap, np.hstack([slope, numerics]), known, offset)
            trials = [rival.moved(share * change[: len(rival.unknowns)]) for share in _SHARES]
            found = self._simulate(tried.motion, [trial.twin for trial in trials])
            ends = [
                (self._left(trial, tried.tracks[truth], made, numerics), trial, made)
                for trial, made in zip(trials, found, strict=True)
                if made is not None
            ]
            best = min(ends, key=lambda end: end[0]) if ends else None
            if best is None or best[0] >= left:
                break
            left, rival, tracks = best
        return left

    def _left(self, rival: Rival, truth: Array, tracks: Array, numerics: Array) -> float:
        """Norm of the difference that the solver's error does not hide, with the way from the recording's optimum."""
        gap = (truth - tracks).reshape(-1) / self.sigma
        known, _ = _known(replace(rival, unknowns=(), information=None, offset=None), numerics.shape[1])
        _, open_ = refit_of(gap, numerics, known)
        away = rival.offset if rival.offset is not None else np.zeros(len(rival.unknowns))
        moved = 0.0 if rival.information is None else float(away @ rival.information @ away)
        return float(np.sqrt(open_**2 + moved))

    def _slopes(self, tried: Tried, number: int, rival: Rival) -> Array | None:
        """Change of a rival's prediction per unknown over the noise, (M, p); None where a run fails."""
        steps = [u.probe for u in rival.unknowns]
        probes = zip(rival.unknowns, steps, strict=True)
        twins = [at(rival.twin, [u], np.array([u.start + step])) for u, step in probes]
        base = tried.tracks[number]
        columns = []
        for tracks, step in zip(self._simulate(tried.motion, twins), steps, strict=True):
            if tracks is None:
                return None
            columns.append((tracks - base).reshape(-1) / (step * self.sigma))
        return np.stack(columns, axis=1) if columns else np.empty((base.size, 0))

    def _numerics(self, tried: Tried) -> Array | None:
        """What finer cells change over the noise, (M, 1), or (M, 0) without them; None where the run fails."""
        if self.finer is None:
            return np.empty((tried.tracks[0].size, 0))
        (finer,) = self._simulate(tried.motion, [self.finer])
        return None if finer is None else (finer - tried.tracks[0]).reshape(-1, 1) / self.sigma

    def _simulate(self, motion: Motion, twins: list[Twin]) -> list[Array | None]:
        # between the frames too: a clock that is off by a part of a frame must not show as interpolation
        there = self._simulations.elsewhere(Drive(self.control_times, motion.points, self.control_times))
        there.stage = STAGE
        found = there.run([Job(twin, len(self.control_times)) for twin in twins])
        self._simulations.count = there.count
        every = (len(self.control_times) - 1) // (len(self.frame_times) - 1)
        return [None if tracks is None else tracks[::every] for tracks in found]


def _known(rival: Rival, numerics: int) -> tuple[Array, Array]:
    """What is known beforehand of a rival's unknowns and of the solver's error: information and offset."""
    count = len(rival.unknowns)
    known = np.diag(np.full(count + numerics, NUMERICS_AMPLITUDE**-2))
    known[:count, :count] = 0.0 if rival.information is None else rival.information
    offset = np.zeros(count + numerics)
    offset[:count] = 0.0 if rival.offset is None else rival.offset
    return known, offset


def drawn_probes(limits: MotionLimits, draws: int, generator: np.random.Generator) -> Iterator[Probe]:
    """Random motions, one of every family first."""
    families = list(COORDINATES)
    for number in range(draws):
        first = number < len(families)
        yield random_probe(
            families[number] if first else families[1 + number % (len(families) - 1)], limits, generator
        )


@dataclass(frozen=True)
class Library:
    """Motions that may be proposed, with their families; the times of frames (T,) and of control points (S,) [s]."""

    motions: tuple[tuple[str, Motion], ...]
    frame_times: Array
    control_times: Array


def library_of(scene: Scene, twin: Twin, draws: int, longest_s: float, seed: int) -> Library:
    """Motions of this scene's grips within its limits, as a search draws them.

    Args:
        scene, twin: whose grips, reach and speed.
        draws: motions.
        longest_s: duration, at most; else as long as the recording.
        seed: everything random follows from it.
    """
    limits = limits_of(scene, twin)
    frame_times, control_times = clock_of(scene, longest_s)
    probes = drawn_probes(limits, draws, np.random.default_rng(seed))
    motions = [
        (probe.family, motion_of(probe, twin.controllers_start, limits, control_times)) for probe in probes
    ]
    return Library(tuple(motions), frame_times, control_times)


def from_rest(twin: Twin) -> Twin:
    """The twin as an experiment finds it: where the first frame saw it, at rest, free to move, and held on to."""
    body = replace(twin.body, start_velocity=np.zeros_like(twin.body.start_velocity))
    return replace(twin, body=body, release_s=0.0, openings=())


def clock_of(scene: Scene, longest_s: float) -> tuple[Array, Array]:
    """Frame times (T,) and control times (S,) [s] of an experiment at the scene's frame rate."""
    duration = min(float(scene.times[-1] - scene.times[0]), longest_s)
    frames = max(round(duration * scene.fps), 4)
    between = max(int(np.ceil(_CONTROL_RATE_HZ / scene.fps)), 1)
    return np.arange(frames + 1) / scene.fps, np.arange(frames * between + 1) / (scene.fps * between)


def _better(best: Tried | None, other: Tried | None) -> Tried | None:
    if best is None or other is None:
        return other or best
    return other if (other.refitted or 0.0) > (best.refitted or 0.0) else best


def _refinement_of(twin: Twin, finer: Twin) -> Twin:
    """``finer``'s lattice with the parameters and effects of ``twin``."""
    return replace(
        finer,
        body=replace(finer.body, points=twin.body.points, offsets=twin.body.offsets),
        law=twin.law,
        air_drag_per_s=twin.air_drag_per_s,
        grip_softness=twin.grip_softness,
        ground_friction=twin.ground_friction,
        effects=twin.effects,
    )
