"""The experiment that tells equivalent models apart: a motion of the grips for which they predict different things.

A recording that cannot tell drag from viscosity leaves several models that fit it alike. For a motion u, model b would
be refitted before anybody called it wrong, so what counts is the difference that refitting cannot hide,

    d_ab(u)^2 = min over x of |f_a(u) - f_b(u) - J_b(u) x|^2 / sigma^2 + x^T H_b x,

f the predicted tracks, J_b the sensitivities of b's unknowns under u, H_b what the recording at hand already says of
them. With white noise d_ab is the distance of the two hypotheses in standard deviations (T-optimal design, Atkinson
and Fedorov 1975, to first order about the optima). The least of it over both directions and all pairs is maximised:
random motions of every family first, by their plain difference (an upper bound), then neighbours of the best; the
winner is confirmed by refitting each rival to what the other predicts, with the full simulator. Motions
keep the limits of :mod:`physworld.demonstrate.limits`, so the experiment asks of a rig nothing that it has not done.

Where even the best motion tells nothing, that is the answer, with what else could be measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.effects.registry import EFFECTS
from physworld.estimation.simulations import Drive, Simulations
from physworld.experiments.rivals import Rival
from physworld.experiments.search import ExperimentConfig, Search, Tried
from physworld.scene import Scene
from physworld.twin.twin import Twin

_LEAST_SHARE = 0.25  # of the noise in a coordinate: nobody knows a body, a grip and a camera better than that


@dataclass(frozen=True)
class Experiment:
    """What to do next.

    Attributes:
        between: labels of the rivals.
        separates: whether the best motion settles the question.
        description: in words.
        motion: family, or None where nothing can be driven.
        times_s, controllers: control points, (S,) from 0 and (S, K, 3) [m]; empty where there is no motion.
        frame_times_s, difference_m: root mean squared difference of the two nearest predictions, (T,), before refits.
        separation_sigmas: after refits, in standard deviations of the noise.
        recording_sigmas: the same of the recording at hand, or None.
        tried, simulations: cost.
        instead: what else would settle it.
    """

    between: tuple[str, ...]
    separates: bool
    description: str
    motion: str | None = None
    times_s: Array = field(default_factory=lambda: np.empty(0))
    controllers: Array = field(default_factory=lambda: np.empty((0, 0, 3)))
    frame_times_s: Array = field(default_factory=lambda: np.empty(0))
    difference_m: Array = field(default_factory=lambda: np.empty(0))
    separation_sigmas: float = 0.0
    recording_sigmas: float | None = None
    tried: int = 0
    simulations: int = 0
    instead: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """JSON types only: ``suggested_experiment`` of a report."""
        return {
            "between": list(self.between),
            "separates": self.separates,
            "description": self.description,
            "motion": self.motion,
            "times_s": rounded(self.times_s),
            "controllers": rounded(self.controllers),
            "frame_times_s": rounded(self.frame_times_s),
            "difference_m": rounded(self.difference_m),
            "separation_sigmas": float(self.separation_sigmas),
            "recording_sigmas": self.recording_sigmas,
            "tried": self.tried,
            "simulations": self.simulations,
            "instead": list(self.instead),
        }


def propose(
    scene: Scene,
    rivals: list[Rival],
    sigma: float,
    *,
    discrepancy: float = 0.0,
    finer: Twin | None = None,
    cost: Callable[[Twin], float] | None = None,
    config: ExperimentConfig | None = None,
    simulations: Simulations | None = None,
) -> Experiment:
    """The motion that tells the rivals apart best.

    Args:
        scene: the recording that does not; limits and frame rate are its own.
        rivals: at least two.
        sigma: tracking noise [m].
        discrepancy: root mean squared error per coordinate, over the noise, that the rivals leave in the recording
            beyond the noise; a difference below it settles nothing, whatever its number of coordinates.
        finer: a twin of the same body on finer cells; what those change is the solver's own error, and a difference
            that looks like it settles nothing either.
        cost: squared whitened misfit of a twin in the recording: rivals that differ in what the recording leaves open
            are brought together first.
        simulations: those of a trace, whose runner, memory and count are used on; None for this process.

    Raises:
        ValueError: fewer than two rivals.
        Cancelled: the trace was.
    """
    if len(rivals) < 2:
        raise ValueError(f"{len(rivals)} rivals: an experiment tells two or more apart")
    config = config or ExperimentConfig()
    simulations = simulations or Simulations(Drive(*scene.control_track(), scene.times))
    labels = tuple(rival.label for rival in rivals)
    known = [EFFECTS[name] for rival in rivals for name in rival.names if name in EFFECTS]
    instead = tuple(dict.fromkeys(effect.instead for effect in known if effect.instead is not None))
    first = rivals[0].twin
    if not first.controller_groups or not any(len(nodes) for nodes in first.held_nodes):
        reason = "Nothing holds this body, so no motion of a grip can be proposed."
        return Experiment(labels, False, reason + _otherwise(instead), instead=instead)
    search = Search(scene, rivals, sigma, finer, cost, config, simulations)
    best = search.best()
    recorded = _of_recording(rivals)
    if best is None or best.refitted is None:
        reason = "None of the motions that were tried can be simulated with every model."
        return Experiment(
            labels, False, reason + _otherwise(instead), recording_sigmas=recorded, tried=search.tried,
            simulations=search.count, instead=instead,
        )  # fmt: skip
    discrepancy = max(discrepancy, _LEAST_SHARE)
    per_coordinate = best.refitted / np.sqrt(best.tracks[0].size)
    separates = bool(best.refitted >= config.enough_sigmas and per_coordinate >= discrepancy)
    return Experiment(
        between=labels,
        separates=separates,
        description=_words(labels, best, recorded, separates, per_coordinate, discrepancy, search, instead),
        motion=best.probe.family,
        times_s=search.control_times,
        controllers=best.motion.points,
        frame_times_s=search.frame_times,
        difference_m=_difference(best.tracks),
        separation_sigmas=best.refitted,
        recording_sigmas=recorded,
        tried=search.tried,
        simulations=search.count,
        instead=instead,
    )


def _of_recording(rivals: list[Rival]) -> float | None:
    """Norm of the least difference between two rivals' whitened residuals of the recording at hand."""
    left = [rival.residual for rival in rivals if rival.residual is not None]
    if len(left) < len(rivals):
        return None
    return min(float(np.linalg.norm(a - b)) for k, a in enumerate(left) for b in left[:k])


def _difference(tracks: tuple[Array, ...]) -> Array:
    """Root mean squared coordinate difference of the two nearest predictions in every frame, (T,) [m]."""
    pairs = [a - b for k, a in enumerate(tracks) for b in tracks[:k]]
    nearest = min(pairs, key=lambda gap: float(np.linalg.norm(gap)))
    apart: Array = np.sqrt(np.mean(nearest**2, axis=(1, 2)))
    return apart


def _words(
    labels: tuple[str, ...],
    best: Tried,
    recorded: float | None,
    separates: bool,
    per_coordinate: float,
    discrepancy: float,
    search: Search,
    instead: tuple[str, ...],
) -> str:
    known = "" if recorded is None else f" (the recording at hand: {_figure(recorded)})"
    figure = f"{_figure(best.refitted or 0.0)} standard deviations of the noise after every refit{known}"
    what = " from ".join((", ".join(labels[:-1]), labels[-1]))
    if separates:
        start = best.motion.words[0].upper() + best.motion.words[1:]
        rate = 1.0 / (search.frame_times[1] - search.frame_times[0])
        peak = 1e3 * float(_difference(best.tracks).max())
        return (
            f"{start}; film {search.frame_times[-1]:.2g} s at {rate:.4g} frames per second. This tells {what}: "
            f"they differ by up to {peak:.2g} mm rms, {figure}."
        )
    why = (
        f"the best of {search.tried} tried gives {figure}"
        if best.refitted is not None and best.refitted < search.config.enough_sigmas
        else f"the best of {search.tried} tried changes a coordinate by {per_coordinate:.2g} of the noise, less "
        f"than the {discrepancy:.2g} that the models leave unexplained"
    )
    return (
        f"No motion of the grips within this recording's reach and speed tells {what}: {why}."
        + _otherwise(instead)
    )


def _figure(value: float) -> str:
    """Three digits at most, without an exponent."""
    return f"{value:.1f}" if value < 100 else f"{float(f'{value:.3g}'):.0f}"


def _otherwise(instead: tuple[str, ...]) -> str:
    return f" Instead: {'; '.join(instead)}." if instead else ""


def rounded(values: Array) -> list[Any]:
    """Nested lists to a thousandth of a millimetre or millisecond."""
    nested: list[Any] = np.round(np.asarray(values, dtype=float), 6).tolist()
    return nested
