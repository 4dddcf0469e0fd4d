"""Other basins of the misfit: where an effect fits with another stiffness than the one that does best without it.

Linear scores ask what an effect does near the optimum of the declared physics. That optimum may be a compromise far
from the truth: a body that rings down is fitted without damping by one so stiff that it hardly rings, and there damping
does nothing; or the phase has slipped by a period; or fibres are so stiff that nothing about them is small. So where
something is to be explained at all, the effects that take energy and fibres are tried at other stiffnesses as well,
with strengths over their range, by simulation of the first half of the training frames: a phase slips less there, and
it costs half. What does much better there is refitted from there on all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.effects.registry import EFFECTS
from physworld.estimation.refit import Refit, sensitivities
from physworld.estimation.simulations import Job, Simulations
from physworld.estimation.unknowns import at, bounds_of, starting_at
from physworld.estimation.whitening import Whitener
from physworld.trace.candidates import Candidate
from physworld.trace.confirm import Confirmation, Model
from physworld.trace.score import Scores

_BETTER = 0.7  # share of the squared residual that a basin may leave
_EARLY = 0.5  # share of the training frames that is looked at


@dataclass(frozen=True)
class Basin:
    """A place from which an effect is worth a refit: the calibrated unknowns there, and the effect's strengths (k,).

    ``cost`` is the squared residual of the early training frames.
    """

    candidate: Candidate
    start: Refit
    strengths: Array
    cost: float


def with_other_basins(
    confirmation: Confirmation,
    base: Model,
    ranked: Scores,
    columns: dict[str, Array],
    tried: list[Model],
    complete: float,
) -> list[Model]:
    """The models that were refitted; one from another basin in the place of its like where it is better.

    Args:
        base: the declared physics.
        ranked: all scores against it.
        columns: whitened sensitivities of every variant, by label, (M, k).
        tried: models with one effect.
        complete: misfit over the noise up to which nothing is left to explain.
    """
    scores = {score.candidate.label: score for score in ranked.ranked}
    chosen = [score.candidate for score in ranked.ranked]
    best = {model.names: model for model in tried}
    frames = confirmation.frames
    found = basins(confirmation.simulations, confirmation.whitener, base.fitted, chosen, frames, complete)
    for basin in found:
        score = replace(scores[basin.candidate.label], strengths=basin.strengths)
        model = confirmation.model(replace(base, fitted=basin.start), [score], columns)
        if model is None:
            continue
        known = best.get(model.names)
        if known is None or model.fitted.misfit < known.fitted.misfit:
            best[model.names] = model
    return list(best.values())


def basins(
    simulations: Simulations,
    whitener: Whitener,
    fitted: Refit,
    chosen: Sequence[Candidate],
    frames: int,
    complete: float,
) -> list[Basin]:
    """The best basin of every such effect that leaves at most 70 % of the early squared residual, best first.

    Args:
        fitted: the optimum without the effects; its first unknown is the stiffness.
        chosen: candidates, in the variants that are tried.
        complete: misfit over the noise up to which nothing is left to explain.
    """
    if fitted.misfit <= complete:
        return []
    known = [c for c in chosen if EFFECTS[c.effect].basins is not None and len(c.gates) == 1]
    low, high = bounds_of(fitted.unknowns)
    first = np.eye(len(low))[0]
    looked = whitener.first + max(int(np.ceil(_EARLY * (frames - whitener.first))), 1)
    early = whitener.frame_of_row < looked
    tries, jobs = [], []
    for candidate in known:
        prepared, gate = candidate.prepared(fitted.twin), candidate.unknowns()[0]
        scan = EFFECTS[candidate.effect].basins
        assert scan is not None  # chosen by it
        for shift in scan.stiffness_shifts:
            place = np.clip(fitted.theta + shift * first, low, high)
            there = at(prepared, fitted.unknowns, place)
            for share in scan.shares:
                strength = share * gate.bounds[1]
                tries.append((candidate, place, strength))
                jobs.append(Job(gate.at(there, strength), looked))
    best: dict[str, tuple[float, Candidate, Array, float]] = {}
    for (candidate, place, strength), tracks in zip(tries, simulations.run(jobs), strict=True):
        if tracks is None:
            continue
        # what comes later is left as it is without the effect
        padded = np.concatenate([tracks, fitted.tracks[looked:]])
        cost = float(np.sum(whitener.residual(padded)[early] ** 2))
        if cost < best.get(candidate.effect, (np.inf,))[0]:
            best[candidate.effect] = (cost, candidate, place, strength)
    limit = _BETTER * float(np.sum(fitted.residual[early] ** 2))
    found = []
    for cost, candidate, place, strength in sorted(best.values(), key=lambda one: one[0]):
        start = _moved(simulations, whitener, fitted, place, frames) if cost <= limit else None
        if start is not None:
            found.append(Basin(candidate, start, np.array([strength]), cost))
    return found


def _moved(
    simulations: Simulations, whitener: Whitener, fitted: Refit, place: Array, frames: int
) -> Refit | None:
    """The declared physics at another place (p,), which is no optimum; None where it cannot be simulated."""
    unknowns = starting_at(fitted.unknowns, place)
    twin = at(fitted.twin, unknowns, place)
    tracks = simulations.run([Job(twin, frames)])[0]
    if tracks is None:
        return None
    slope, _ = sensitivities(simulations, whitener, twin, tracks, unknowns, frames)
    return Refit(unknowns, twin, place, tracks, whitener.residual(tracks), slope)
