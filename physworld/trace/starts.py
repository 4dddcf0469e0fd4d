"""Where fits of a hypothesis begin.

*Near* starts are the linear estimate of the strengths, multiples of it (a strength is underestimated where motion has
run out of phase), and both where other hypotheses have come to rest (their *basins*). *Far* starts are estimates of the
strengths beside other stiffnesses. *Scanned* ones are shares of the strengths' range beside the material of the best
hypothesis, for what is strong says little of itself to first order. All are ranked on the first part of the recording,
where phases have not slipped yet; the best of the far ones are first fitted to that part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.parameters import BENDING_RATIO, TWIST_RATIO
from physworld.estimation.noise import Split
from physworld.estimation.refit import refit
from physworld.estimation.simulations import Job
from physworld.estimation.unknowns import Unknown, at, bounds_of, starting_at, starts_of
from physworld.estimation.whitening import ScaledWhitener, Whitener
from physworld.trace.hypotheses import Hypothesis, Setting, Values
from physworld.trace.posterior import removes
from physworld.trace.screening import Screened

_EARLY = 0.4  # share of the training frames on which starts are ranked
_MULTIPLES = (0.3, 3.0, 9.0)  # of a linear estimate
_SCANNED = (1.0, 0.3, 0.1, 0.03, 0.01)  # of a strength's range, beside known numbers
_PROFILE = (
    5,
    2,
    2,
)  # stiffnesses beside which strengths are estimated, of each base; of a variant at least two
_STIFFNESS = 1.0  # logarithms of the stiffness that they span, up and down
_FOLLOWED = 3  # of all starts, the best on the early frames whose stiffness differs
_ITERATIONS = 2  # of each of these, on the early frames
_SHIFTS = tuple(0.12 * k for k in range(-6, 7))  # logarithms of the stiffness about a place
_SHAPES = (TWIST_RATIO, BENDING_RATIO)
NO_WORSE = 2.0  # times the best one's squared error: a start that is no worse is followed
_APART = 0.1  # logarithm of the stiffness by which two places are in two basins


@dataclass(frozen=True)
class Begun:
    """Where the fit of a candidate beside a hypothesis begins.

    Attributes:
        screened: its first-order score.
        starts: places, by name, the best first.
        promised: share of the root mean square above the noise that the best one removes on the early frames.
    """

    screened: Screened
    starts: list[Values]
    promised: float


@dataclass(frozen=True)
class Starts:
    """Makes and ranks starts.

    Attributes:
        setting: what all hypotheses share.
        early: whitener of the first part of the training frames, by the noise alone, and their end.
        calibrated: where the calibration ended, by name, of a rod, whose losses are effects here: without them the
            declared physics comes to rest elsewhere. Of other bodies nothing.
    """

    setting: Setting
    early: tuple[Whitener, int]
    calibrated: Values

    def begun(self, base: Hypothesis, one: Screened, basins: Sequence[Hypothesis], far: float = 0.0) -> Begun:
        """The best of the near starts, and of the far ones, of different stiffnesses.

        Args:
            base: the hypothesis that gets an effect more.
            one: the effect's score beside it.
            basins: hypotheses whose calibrated numbers are tried too.
            far: share of the far starts.
        """
        starts = [*self._near(base, one, basins), *(self._profiled(base, one, far) if far else ())]
        unknowns, places, errors = self._ranked(base, one, starts)
        first = [u.name for u in unknowns].index(self.setting.calibrated[0].name)
        order = [int(k) for k in np.argsort(errors) if errors[k] <= NO_WORSE * min(errors)]
        best = [order[j] for j in distinct([places[k][first] for k in order])][:_FOLLOWED]
        return Begun(one, [_named(unknowns, places[k]) for k in best], self._promised(base, min(errors)))

    def scanned(self, base: Hypothesis, one: Screened, known: Hypothesis) -> Begun:
        """The best of the scanned starts with the calibrated numbers of a hypothesis that is fitted."""
        starts = self._scan(base, one, known.values)
        unknowns, places, errors = self._ranked(base, one, starts)
        best = int(np.argmin(errors))
        return Begun(one, [_named(unknowns, places[best])], self._promised(base, errors[best]))

    def followed(self, base: Hypothesis, begun: Begun, every: bool) -> Begun:
        """Fits to the early frames from these starts, or from the first alone."""
        starts = begun.starts if every else begun.starts[:1]
        unknowns, places, errors = self._ranked(base, begun.screened, starts)
        twin, _ = self.setting.assembled((*base.members, begun.screened.candidate), base.values)
        white, frames = self.early
        fits: list[tuple[float, Values]] = []
        for place, error in zip(places, errors, strict=True):
            scaled, here = ScaledWhitener(white, self.setting.counted(error)), starting_at(unknowns, place)
            found = refit(self.setting.simulations, scaled, twin, here, frames, _ITERATIONS, hopeless=0.0)
            if found is not None:
                fits.append(((scaled.scale * found.misfit) ** 2, _named(found.unknowns, found.theta)))
        fits = sorted(fits, key=lambda fit: fit[0]) or [(min(errors), begun.starts[0])]
        return Begun(begun.screened, [values for _, values in fits], self._promised(base, fits[0][0]))

    def promised(self, base: Hypothesis, known: Hypothesis) -> float:
        """Share of what ``base`` leaves on the early frames that goes with a hypothesis that is fitted."""
        return self._promised(base, self._error(known.fitted.tracks))

    def _promised(self, base: Hypothesis, error: float) -> float:
        return removes(self._error(base.fitted.tracks), error)

    def _error(self, tracks: Array | None) -> float:
        """Mean squared residual on the early frames; infinite for a run that failed."""
        white, frames = self.early
        return np.inf if tracks is None else float(np.mean(white.residual(tracks[:frames]) ** 2))

    def _ranked(
        self, base: Hypothesis, one: Screened, starts: Sequence[Values]
    ) -> tuple[list[Unknown], list[Array], list[float]]:
        """Unknowns, places (p,) of the starts, and mean squared residuals of each on the early frames."""
        members = (*base.members, one.candidate)
        twin, unknowns = self.setting.assembled(members, base.values)
        low, high = bounds_of(unknowns)
        places = [np.clip([start.get(u.name, u.start) for u in unknowns], low, high) for start in starts]
        runs = self.setting.simulations.run(
            [Job(at(twin, unknowns, place), self.early[1]) for place in places]
        )
        return unknowns, places, [self._error(tracks) for tracks in runs]

    def _near(self, base: Hypothesis, one: Screened, basins: Sequence[Hypothesis]) -> list[Values]:
        linear = {**base.values, **one.values}
        strengths = {u.name: linear[u.name] for u in one.candidate.unknowns()}
        starts: list[Values] = [linear, {**base.values, **strengths}]
        starts += [{**linear, **{n: f * s for n, s in strengths.items()}} for f in _MULTIPLES]
        for other in basins:
            kept = {n: v for n, v in other.values.items() if n in base.values}
            starts += [
                {**base.values, **kept, **{n: f * s for n, s in strengths.items()}} for f in (1.0, 0.3, 3.0)
            ]
        if not self.calibrated:
            return starts
        return starts + self._scan(base, one, self.calibrated)

    def _scan(self, base: Hypothesis, one: Screened, numbers: Values) -> list[Values]:
        """Shares of the strengths' range beside other calibrated numbers, where what was estimated elsewhere only has a
        direction."""
        kept = {n: v for n, v in numbers.items() if n in base.values}
        ranges = {u.name: max(abs(end) for end in u.bounds) for u in one.candidate.unknowns()}
        strengths = {n: one.values[n] for n in ranges}
        largest = max((abs(s) / ranges[n] for n, s in strengths.items()), default=1.0) or 1.0
        return [
            {**base.values, **kept, **{n: share / largest * s for n, s in strengths.items()}}
            for share in _SCANNED
        ]

    def _profiled(self, base: Hypothesis, one: Screened, share: float) -> list[Values]:
        """One Gauss-Newton step of the strengths alone on the early frames, beside other stiffnesses, and beside fewer
        of them with each of the other bases: a strength that is estimated beside a wrong stiffness says little."""
        white, frames = self.early
        scaled = ScaledWhitener(white, self.setting.counted(self._error(base.fitted.tracks)))
        first, gates = self.setting.calibrated[0].name, [u.name for u in one.candidate.unknowns()]
        twin, unknowns = self.setting.assembled((*base.members, one.candidate), base.values)
        found: list[Values] = []
        for known, count in zip(_bases(self.setting.calibrated, base.values), _PROFILE, strict=False):
            for shift in np.linspace(-_STIFFNESS, _STIFFNESS, max(int(share * count), _PROFILE[-1])):
                place = {**known, first: known[first] + float(shift)}
                here = [u.starting(place.get(u.name, u.start)) for u in unknowns]
                around = at(twin, here, starts_of(here))
                own = [u for u in here if u.name in gates]
                fit = refit(self.setting.simulations, scaled, around, own, frames, 1, hopeless=0.0)
                if fit is not None:
                    found.append(place | _named(fit.unknowns, fit.theta))
        return found


def early_part(white: Whitener, split: Split) -> tuple[Whitener, int]:
    """The whitener of the first part of the training frames, and the frame at which that ends."""
    end = split.train[0] + max(int(np.ceil(_EARLY * (split.train[1] - split.train[0]))), 3)
    return white.until(end), end


def elsewhere(unknowns: Sequence[Unknown], own: Values) -> list[list[Values]]:
    """Where calibrated numbers are looked for beside where they are, as lists of places over the stiffness, for a phase
    that has slipped by a period is a local minimum. The first list is about the place itself; one more each has another
    value of what decides in which of these minima it lies: the shapes of a sheet's stiffness, one deviation of their
    priors away, and what is not known at all beforehand, as how sharply grips hold, a quarter of its range from its
    lower end.

    Args:
        unknowns: what is calibrated, the stiffness first.
        own: where they are, by name, in the scale of the search.
    """
    first = unknowns[0].name
    return [[{**base, first: own[first] + shift} for shift in _SHIFTS] for base in _bases(unknowns, own)]


def _bases(unknowns: Sequence[Unknown], own: Values) -> list[Values]:
    """The place itself, and one more each with another value of what decides about phases: see :func:`elsewhere`."""
    bases = [own]
    for u in unknowns[1:]:
        if u.name in own and u.prior is None:
            bases.append({**own, u.name: u.bounds[0] + 0.25 * (u.bounds[1] - u.bounds[0])})
        elif u.name in own and u.name in _SHAPES and u.prior is not None:
            bases.append({**own, u.name: own[u.name] + u.prior[1]})
    return bases


def distinct(stiffnesses: Sequence[float], taken: Sequence[float] = ()) -> list[int]:
    """Which of these stiffnesses (logarithms) lie in other basins than those taken and those before them."""
    found: list[int] = []
    for k, own in enumerate(stiffnesses):
        if all(abs(own - other) > _APART for other in [*taken, *(stiffnesses[j] for j in found)]):
            found.append(k)
    return found


def _named(unknowns: Sequence[Unknown], theta: Array) -> dict[str, float]:
    return {u.name: float(t) for u, t in zip(unknowns, theta, strict=True)}
