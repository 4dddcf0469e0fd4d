"""The search for a motion that tells models apart: see :mod:`physworld.trace.experiment`.

Every motion costs one simulation a rival, and one more for every number that a refit would change. The plain
difference of two predictions is an upper bound of the one after refits, so only motions whose plain difference beats
the best so far are looked at more closely.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from physworld.demonstrate.limits import MotionLimits, limits_of
from physworld.scene import Scene
from physworld.trace.confirm import Model
from physworld.trace.probing import COORDINATES, Motion, Probe, motion_of, nudged, random_probe
from physworld.trace.refit import prior_rows
from physworld.trace.sensitivity import refinement_of
from physworld.trace.simulations import Drive, Job, Memory, Progress, Runner, Simulations
from physworld.trace.unknowns import Unknown, at
from physworld.twin import Twin

STAGE = "experiment"
NUMERICS_AMPLITUDE = 3.0  # deviation of the solver's own error, over the change by finer cells
_CONTROL_RATE_HZ = 100.0  # control points are given, and predictions made, at least this often
_RIDGE = 1e-9


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
class Rival:
    """A model to be told from others.

    Attributes:
        names: its effects.
        twin: at its optimum.
        unknowns: what a refit would change, starting at the optimum.
        information: what the recording at hand says of them, (p, p); None: nothing.
        residual: whitened, of the recording at hand, (M,), or None.
    """

    names: tuple[str, ...]
    twin: Twin
    unknowns: tuple[Unknown, ...] = ()
    information: np.ndarray | None = None
    residual: np.ndarray | None = None

    @property
    def label(self) -> str:
        """For people."""
        return " and ".join(self.names) or "the declared physics"


def rival_of(model: Model) -> Rival:
    """A refitted model as a rival."""
    fitted = model.fitted
    _, slope = prior_rows(fitted.unknowns, fitted.theta)
    information = fitted.jacobian.T @ fitted.jacobian + slope.T @ slope
    return Rival(model.names, fitted.twin, tuple(fitted.unknowns), information, fitted.residual)


@dataclass(frozen=True)
class Tried:
    """A motion with every rival's prediction (T, N, 3), its plain separation and that after refits (None: open)."""

    probe: Probe
    motion: Motion
    tracks: tuple[np.ndarray, ...]
    plain: float
    refitted: float | None = None


class Search:
    """State of one search."""

    def __init__(
        self,
        scene: Scene,
        rivals: list[Rival],
        sigma: float,
        finer: Twin | None,
        config: ExperimentConfig,
        runner: Runner,
        memory: Memory | None,
        progress: Progress | None,
        cancelled: Callable[[], bool] | None,
    ) -> None:
        self.rivals = [replace(rival, twin=from_rest(rival.twin)) for rival in rivals]
        self.finer = None if finer is None else from_rest(refinement_of(rivals[0].twin, finer))
        self.sigma, self.config = sigma, config
        self.limits: MotionLimits = limits_of(scene, rivals[0].twin)
        self.pose = rivals[0].twin.controllers_start
        self.frame_times, self.control_times = clock_of(scene, config.longest_s)
        self._run = (runner, memory or Memory(), progress, cancelled)
        self.count = self.tried = 0

    def best(self) -> Tried | None:
        """The best motion found within the budget; None where no motion could be simulated."""
        config, generator = self.config, np.random.default_rng(self.config.seed)
        families = list(COORDINATES)
        drawn = []
        for number in range(config.draws):
            family = (
                families[number] if number < len(families) else families[1 + number % (len(families) - 1)]
            )
            found = self._try(random_probe(family, self.limits, generator))
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
        return best

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
        jobs = [
            (k, unknown, step)
            for k, rival in enumerate(self.rivals)
            for unknown in rival.unknowns
            for step in (-unknown.step if unknown.start + unknown.step > unknown.high else unknown.step,)
        ]
        if self.count + len(jobs) + 1 > self.config.simulations and not forced:
            return None
        twins = [at(self.rivals[k].twin, [u], np.array([u.start + step])) for k, u, step in jobs]
        found = self._simulate(tried.motion, twins + ([] if self.finer is None else [self.finer]))
        if any(tracks is None for tracks in found):
            return None
        slopes: list[list[np.ndarray]] = [[] for _ in self.rivals]
        for (k, _, step), tracks in zip(jobs, found, strict=False):
            slopes[k].append((tracks - tried.tracks[k]).reshape(-1) / (step * self.sigma))
        numerics = [] if self.finer is None else [(found[-1] - tried.tracks[0]).reshape(-1) / self.sigma]
        least = np.inf
        for a, b in permutations(range(len(self.rivals)), 2):
            gap = (tried.tracks[a] - tried.tracks[b]).reshape(-1) / self.sigma
            slope = np.array([*slopes[b], *numerics]).reshape(-1, gap.size).T
            least = min(least, separation(gap, slope, self._known(b, len(numerics))))
        return replace(tried, refitted=least)

    def _known(self, rival: int, numerics: int) -> np.ndarray:
        """What is known beforehand of a rival's unknowns and of the solver's error, (p + numerics,) squared."""
        unknowns, given = len(self.rivals[rival].unknowns), self.rivals[rival].information
        known = np.diag(np.full(unknowns + numerics, NUMERICS_AMPLITUDE**-2))
        known[:unknowns, :unknowns] = 0.0 if given is None else given
        return known

    def _simulate(self, motion: Motion, twins: list[Twin]) -> list[np.ndarray | None]:
        runner, memory, progress, cancelled = self._run
        # between the frames too: a clock that is off by a part of a frame must not show as interpolation
        drive = Drive(self.control_times, motion.points, self.control_times)
        simulations = Simulations(drive, runner, memory, _onward(progress, self.count), cancelled)
        simulations.stage = STAGE
        found = simulations.run([Job(twin, len(self.control_times)) for twin in twins])
        self.count += simulations.count
        every = (len(self.control_times) - 1) // (len(self.frame_times) - 1)
        return [None if tracks is None else tracks[::every] for tracks in found]


def separation(difference: np.ndarray, slope: np.ndarray, information: np.ndarray | None) -> float:
    """Norm of a difference (M,) over the noise that the unknowns with ``slope`` (M, p) cannot hide.

    Args:
        information: what else is known of the unknowns, (p, p); None: nothing.
    """
    if not slope.shape[1]:
        return float(np.linalg.norm(difference))
    normal = slope.T @ slope + (0.0 if information is None else information)
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    ridged = normal / np.outer(scale, scale) + _RIDGE * np.eye(len(scale))
    product = slope.T @ difference / scale
    left = float(difference @ difference) - float(product @ np.linalg.solve(ridged, product))
    return float(np.sqrt(max(left, 0.0)))


def from_rest(twin: Twin) -> Twin:
    """The twin as an experiment finds it: where the first frame saw it, at rest, and free from the start."""
    body = replace(twin.body, start_velocity=np.zeros_like(twin.body.start_velocity))
    return replace(twin, body=body, release_s=0.0)


def clock_of(scene: Scene, longest_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Frame times (T,) and control times (S,) [s] of an experiment at the scene's frame rate."""
    duration = min(float(scene.times[-1] - scene.times[0]), longest_s)
    frames = max(round(duration * scene.fps), 4)
    between = max(int(np.ceil(_CONTROL_RATE_HZ / scene.fps)), 1)
    return np.arange(frames + 1) / scene.fps, np.arange(frames * between + 1) / (scene.fps * between)


def _better(best: Tried | None, other: Tried | None) -> Tried | None:
    if best is None or other is None:
        return other or best
    return other if (other.refitted or 0.0) > (best.refitted or 0.0) else best


def _onward(progress: Progress | None, before: int) -> Progress | None:
    if progress is None:
        return None
    return lambda done, total, stage: progress(before + done, total, stage)
