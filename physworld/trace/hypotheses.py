"""A hypothesis: a set of effects beside the calibrated numbers, fitted and held against left-out blocks of frames.

A fit weighs the residual against the priors by how much a sighting counts (:mod:`physworld.estimation.left_out`):
where a twin errs by a hundred times a camera's noise, ten thousand sightings do not fix a stiffness to a part in a
million.

Nothing here knows what an effect is: its numbers, their bounds and priors, its shapes and their mirror images come from
the effect's own file by way of the candidates.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.errors import SimulationError
from physworld.estimation.left_out import LeftOut, Linear, counted, left_out
from physworld.estimation.refit import Refit, prior_rows, refit
from physworld.estimation.simulations import Job
from physworld.estimation.unknowns import Unknown, at
from physworld.estimation.whitening import ScaledWhitener, Whitener
from physworld.trace.candidates import Candidate
from physworld.trace.recordings import JointSimulations
from physworld.twin.twin import Twin

Values = Mapping[str, float]
"""Places of unknowns in the scale of their search, by name."""
_ROUNDS = 3  # fits in turn with an estimate of what a sighting counts
_SAME = 1.5  # ratio of two such estimates that are one
_NUMBERS_AN_ITERATION = 8  # a rod of twenty-four numbers does not settle in the iterations that three need


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects with everything fitted.

    Attributes:
        members: the candidates in it; none: the declared physics.
        fitted: the optimum; residual and Jacobian are whitened by ``white``.
        unseen: its errors on left-out blocks.
        white: by noise, solver, and the points' places as its own motion carries them.
    """

    members: tuple[Candidate, ...]
    fitted: Refit
    unseen: LeftOut
    white: Whitener

    @property
    def names(self) -> tuple[str, ...]:
        """Effects, in alphabetical order."""
        return tuple(sorted(member.effect for member in self.members))

    @property
    def values(self) -> dict[str, float]:
        """Where every unknown is, in the scale of its search."""
        return {u.name: float(t) for u, t in zip(self.fitted.unknowns, self.fitted.theta, strict=True)}

    @property
    def left(self) -> float:
        """Mean squared error of left-out blocks over the noise's: 1 for a perfect model."""
        return self.unseen.mean

    @property
    def log_prior(self) -> float:
        """Log of the prior density of the effects' strengths, over that at its top."""
        own = [k for k, u in enumerate(self.fitted.unknowns) if u.name.split(".")[0] in self.names]
        residual, _ = prior_rows(self.fitted.unknowns, self.fitted.theta)
        return -0.5 * float(np.sum(residual[own] ** 2))

    @property
    def doubt(self) -> str | None:
        """Why nobody would believe its numbers, whatever a recording says; None where one may."""
        own = (e.implausible() for e in self.fitted.twin.effects if e.name in self.names)
        return next((reason for reason in own if reason is not None), None)


@dataclass(frozen=True)
class Setting:
    """What all hypotheses of a trace share.

    Attributes:
        simulations: of the recordings.
        white: by noise, places and solver, of the calibrated twin.
        whitening: the same of a twin whose tracked points answer so to their own places, (frames, N, 3, r), and of its
            tracks.
        blocks: rows of every block of frames.
        frames: from the first to before this one.
        iterations: of a fit of few numbers.
        twin: of the declared physics.
        calibrated: unknowns that every hypothesis has.
    """

    simulations: JointSimulations
    white: Whitener
    whitening: Callable[[Array, Array], Whitener]
    blocks: Sequence[Array]
    frames: int
    iterations: int
    twin: Twin
    calibrated: Sequence[Unknown]

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

    def counted(self, error: float) -> float:
        """Deviations of the noise that a sighting counts as at a mean squared residual of ``error``."""
        return counted(error, sum(len(rows) for rows in self.blocks), len(self.blocks))

    def best_of(
        self, members: Sequence[Candidate], places: Sequence[Values], white: Whitener
    ) -> tuple[Values, float]:
        """Of several places of a set of effects the one with the smallest mean squared residual, and that."""
        twin, unknowns = self.assembled(members, places[0])
        thetas = [[place.get(u.name, u.start) for u in unknowns] for place in places]
        runs = self.simulations.run([Job(at(twin, unknowns, np.array(t)), self.frames) for t in thetas])
        errors = [np.inf if t is None else float(np.mean(white.residual(t) ** 2)) for t in runs]
        best = int(np.argmin(errors))
        return places[best], errors[best]

    def fitted(
        self,
        members: Sequence[Candidate],
        values: Values,
        starts: Sequence[Values] = (),
        shapes: bool = True,
        scale: float = 1.0,
        hopeless: float = np.inf,
        white: Whitener | None = None,
    ) -> Hypothesis | None:
        """A hypothesis from the best of several starts; None where no run was usable.

        Args:
            members: its effects.
            values, starts: where unknowns start, by name.
            shapes: whether the numbers that only shape effects are free.
            scale: deviations of the noise that a sighting counts as, as a first guess.
            hopeless: squared residual, over the noise, above which the search ends after two iterations.
            white: as a first guess, of another hypothesis; None for the calibrated twin's.
        """
        white = white or self.white
        twin, unknowns = self.assembled(members, values, shapes)
        places = [np.array([start.get(u.name, u.start) for u in unknowns]) for start in starts]
        found: Hypothesis | None = None
        known: Array | None = None
        iterations = self.iterations + len(unknowns) // _NUMBERS_AN_ITERATION
        for number in range(_ROUNDS):
            limit = hopeless / scale**2
            scaled = ScaledWhitener(white, scale)
            done = refit(
                self.simulations, scaled, twin, unknowns, self.frames, iterations, places, limit, known
            )
            if done is None:
                return found
            own = self._own(done) or white
            slopes = own.over_from(white, scale * done.jacobian)
            plain = replace(done, residual=own.residual(done.tracks), jacobian=slopes)
            linear = Linear(plain.residual, plain.jacobian, plain.unknowns, plain.theta)
            new = Hypothesis(tuple(members), plain, left_out(linear, self.blocks, scale), own)
            if found is None or new.left <= found.left:
                found = new
            following = new.unseen.scale
            if number and max(scale, following) <= _SAME * min(scale, following):
                break
            if float(np.sum(plain.residual**2)) > hopeless:
                break
            scale, unknowns, places, hopeless, white = following, done.unknowns, [], np.inf, own
            known = plain.jacobian / scale
        return found

    def _own(self, done: Refit) -> Whitener | None:
        """The whitener of a twin's own motion; None where that cannot be trusted."""
        try:
            return self.whitening(self.simulations.first_look(Job(done.twin, self.frames))[1], done.tracks)
        except SimulationError:
            return None
