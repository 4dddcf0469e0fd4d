"""Confirmation: candidates refitted with the full simulator, alone and in pairs, and compared across blocks.

The simplest model first. Singles are refitted in the order of their scores, one variant of an effect at a time. Where
the best single leaves more than it should, what it leaves is scored again with its own sensitivities projected out, and
pairs of it with the best seconds are refitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.trace.candidates import Candidate
from physworld.trace.comparison import CrossValidation, cross_validated, difference
from physworld.trace.refit import Refit, refit
from physworld.trace.score import Score, project
from physworld.trace.simulations import Simulations
from physworld.trace.unknowns import Unknown
from physworld.trace.whitening import Whitener

_MEANINGFUL = 2.0  # standard errors by which a model must predict better than a simpler one
_STARTS, _GLANCE = 3, 2  # variants of an effect that are tried, and iterations after which the best goes on
_NUDGE = 0.1  # of a probe: where a search starts if the linear estimate says none, so that shapes can show


@dataclass(frozen=True)
class Model:
    """A set of effects with everything refitted.

    Attributes:
        members: the candidates in it, in the order in which they were found; none: the declared physics.
        fitted: the optimum.
        validated: its errors on left-out blocks.
    """

    members: tuple[Candidate, ...]
    fitted: Refit
    validated: CrossValidation

    @property
    def names(self) -> tuple[str, ...]:
        """Effects."""
        return tuple(member.effect for member in self.members)

    @property
    def explained(self) -> float:
        """Excess of the squared misfit over the noise."""
        return max(self.fitted.misfit**2 - 1.0, 0.0)


def beats(better: Model, worse: Model) -> bool:
    """Whether left-out blocks are predicted better by more than chance."""
    gain, spread = difference(worse.validated, better.validated)
    return gain > _MEANINGFUL * spread


@dataclass
class Confirmation:
    """Refits of one trace; keeps what they share."""

    simulations: Simulations
    whitener: Whitener
    block_of_row: np.ndarray
    frames: int
    iterations: int

    def model(self, base: Model, variants: list[Score], columns: dict[str, np.ndarray]) -> Model | None:
        """``base`` with one effect more, everything refitted; None where no run was usable.

        Args:
            variants: scores of the effect's variants against the base's residual, the ones to start from.
            columns: whitened sensitivities at zero of every variant, by label, (M, k).
        """
        brief = self.iterations if len(variants) == 1 else _GLANCE
        starts = [self._with_gates(base, score, columns[score.candidate.label], brief) for score in variants]
        usable = [(s.candidate, f) for s, f in zip(variants, starts, strict=True) if f is not None]
        if not usable:
            return None
        candidate, found = min(usable, key=lambda pair: pair[1].misfit)
        unknowns = [*found.unknowns, *candidate.shape_unknowns()]
        if candidate.shapes or len(variants) > 1:
            again = refit(self.simulations, self.whitener, found.twin, unknowns, self.frames, self.iterations)
            found = again or found
        return Model((*base.members, candidate), found, cross_validated(found, self.block_of_row))

    def _with_gates(self, base: Model, score: Score, columns: np.ndarray, iterations: int) -> Refit | None:
        """The refit of a variant whose shape stays as it is."""
        candidate = score.candidate
        gates = candidate.unknowns()
        freed = {gate.name for gate in gates}
        keep = [k for k, u in enumerate(base.fitted.unknowns) if u.name not in freed]
        known = [base.fitted.unknowns[k] for k in keep]
        strengths = _away_from_zero(score.strengths, gates)
        linear = _linear(base.fitted, score.strengths, columns)[keep]
        start = np.concatenate([linear, strengths])
        own = np.concatenate([[u.start for u in known], strengths])
        half = np.concatenate([0.5 * (linear + own[: len(known)]), 0.5 * strengths])
        unknowns = [u.starting(t) for u, t in zip([*known, *gates], start, strict=True)]
        prepared = candidate.prepared(base.fitted.twin)
        return refit(
            self.simulations, self.whitener, prepared, unknowns, self.frames, iterations, [own, half]
        )


def _linear(fitted: Refit, strengths: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Where the base's unknowns go, to first order, once the candidate has its strengths; (p,)."""
    left = fitted.residual - columns @ strengths
    change = np.linalg.lstsq(fitted.jacobian, left, rcond=1e-8)[0]
    low, high = np.array([u.low for u in fitted.unknowns]), np.array([u.high for u in fitted.unknowns])
    limit = 0.3 * (high - low)
    return np.clip(fitted.theta + np.clip(change, -limit, limit), low, high)


def _away_from_zero(strengths: np.ndarray, gates: list[Unknown]) -> np.ndarray:
    if np.any(np.abs(strengths) > _NUDGE):
        return strengths
    return np.array([_NUDGE if gate.high > 0 else -_NUDGE for gate in gates])


def best_variants(
    ranked: list[Score], least: float, count: int, besides: tuple[str, ...] = ()
) -> list[list[Score]]:
    """The best variants of every effect whose variants together score at least ``least``, ``count`` effects at most.

    One variant where the effect has no shapes to free, else the best three: a linear score does not tell which of them
    leads to the right shape.
    """
    found: dict[str, list[Score]] = {}
    for score in ranked:
        own = found.setdefault(score.candidate.effect, [])
        most = _STARTS if score.candidate.shapes else 1
        wanted = score.family >= least and score.share > 0.0 and score.candidate.effect not in besides
        if wanted and len(own) < most:
            own.append(score)
    return sorted((own for own in found.values() if own), key=lambda own: -own[0].family)[:count]


def explained_direction(model: Model, base: Model, basis: np.ndarray) -> np.ndarray:
    """What a model explains of the base's residual, (M,), after projection."""
    return project(basis, base.fitted.residual - model.fitted.residual)
