"""A hypothesis: a set of effects beside the calibrated numbers, fitted under noise and discrepancy.

Nothing here knows what an effect is: its numbers, their bounds and priors, its shapes and their mirror images come from
the effect's own file by way of the candidates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from physworld.estimation.refit import Refit, refit
from physworld.estimation.simulations import Simulations
from physworld.estimation.unknowns import Unknown
from physworld.estimation.whitening import Whitener
from physworld.trace.candidates import Candidate
from physworld.trace.discrepancy import Discrepancy, DiscrepancyWhitener
from physworld.trace.likelihood import Evidence, Linear, evidence
from physworld.twin.twin import Twin

Values = Mapping[str, float]
"""Places of unknowns in the scale of their search, by name."""
_ROUNDS = 3  # fits in turn with an estimate of the discrepancy
_SAME = 1.5  # ratio of two amplitudes of the discrepancy that are one


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects with everything fitted.

    Attributes:
        members: the candidates in it; none: the declared physics.
        fitted: the optimum; residual and Jacobian are whitened by noise, places and solver only.
        evidence: what the data say of it.
    """

    members: tuple[Candidate, ...]
    fitted: Refit
    evidence: Evidence

    @property
    def names(self) -> tuple[str, ...]:
        """Effects, in alphabetical order."""
        return tuple(sorted(member.effect for member in self.members))

    @property
    def values(self) -> dict[str, float]:
        """Where every unknown is, in the scale of its search."""
        return {u.name: float(t) for u, t in zip(self.fitted.unknowns, self.fitted.theta, strict=True)}

    @property
    def score(self) -> float:
        """Log density of all blocks, each given the others."""
        return float(self.evidence.left_out.sum())

    @property
    def left(self) -> float:
        """Mean squared error of left-out blocks over the noise's: 1 for a perfect model."""
        return float(np.average(self.evidence.errors, weights=self.evidence.sizes))

    @property
    def doubt(self) -> str | None:
        """Why nobody would believe its numbers, whatever a recording says; None where one may."""
        own = (e.implausible() for e in self.fitted.twin.effects if e.name in self.names)
        return next((reason for reason in own if reason is not None), None)

    @property
    def linear(self) -> Linear:
        """About its optimum."""
        return Linear(self.fitted.residual, self.fitted.jacobian, self.fitted.unknowns, self.fitted.theta)


@dataclass(frozen=True)
class Setting:
    """What all hypotheses of a trace share.

    Attributes:
        simulations: of the recordings.
        white: by noise, places and solver.
        discrepancy: that every hypothesis has.
        frames: from the first to before this one.
        iterations: of a fit.
        twin: of the declared physics.
        calibrated: unknowns that every hypothesis has.
    """

    simulations: Simulations
    white: Whitener
    discrepancy: Discrepancy
    frames: int
    iterations: int
    twin: Twin
    calibrated: Sequence[Unknown]

    def whitened(self, kappa: float) -> DiscrepancyWhitener:
        """The whitener with a discrepancy of this amplitude [m]."""
        return DiscrepancyWhitener(self.white, self.discrepancy, kappa)

    def assembled(
        self, members: Sequence[Candidate], values: Values, shapes: bool = True
    ) -> tuple[Twin, list[Unknown]]:
        """The twin and the unknowns of a set of effects.

        Args:
            members: the effects.
            values: where unknowns start, those that are not among them where they are by themselves.
            shapes: whether the numbers that only shape effects are free.
        """
        twin, own = self.twin, []
        for member in members:
            twin = member.prepared(twin)
            own += [*member.unknowns(), *(member.shape_unknowns() if shapes else ())]
        names = {unknown.name for unknown in own}
        unknowns = [*(u for u in self.calibrated if u.name not in names), *own]
        unknowns = [u.starting(values.get(u.name, u.start)) for u in unknowns]
        return twin, unknowns

    def fitted(
        self,
        members: Sequence[Candidate],
        values: Values,
        starts: Sequence[Values] = (),
        shapes: bool = True,
        hopeless: float = np.inf,
    ) -> Hypothesis | None:
        """A hypothesis from the best of several starts; None where no run was usable.

        Args:
            members: its effects.
            values, starts: where unknowns start, by name.
            shapes: whether the numbers that only shape effects are free.
            hopeless: squared residual above which the search ends after two iterations.
        """
        twin, unknowns = self.assembled(members, values, shapes)
        places = [np.array([start.get(u.name, u.start) for u in unknowns]) for start in starts]
        found: Hypothesis | None = None
        kappa, known = 0.0, None
        for _ in range(_ROUNDS):
            white = self.whitened(kappa)
            done = refit(
                self.simulations, white, twin, unknowns, self.frames, self.iterations, places, hopeless, known
            )
            if done is None:
                return found
            plain = replace(
                done,
                residual=self.white.residual(done.tracks),
                jacobian=self.discrepancy.unwhitened(done.jacobian, kappa),
            )
            linear = Linear(plain.residual, plain.jacobian, plain.unknowns, plain.theta)
            new = Hypothesis(tuple(members), plain, evidence(linear, self.discrepancy))
            if found is None or new.score >= found.score:
                found = new
            following = new.evidence.kappa
            if _alike(kappa, following, self.white.sigma) or float(np.sum(plain.residual**2)) > hopeless:
                break
            kappa, unknowns, places, hopeless = following, done.unknowns, [], np.inf
            known = self.discrepancy.whitened(plain.jacobian, kappa)
        return found


def _alike(kappa: float, other: float, sigma: float) -> bool:
    """Whether two amplitudes of the discrepancy are one as far as a fit goes."""
    low, high = sorted((max(kappa, 0.3 * sigma), max(other, 0.3 * sigma)))
    return high <= _SAME * low
