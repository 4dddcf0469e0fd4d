"""One search over sets of effects: forward additions, backward deletions, starts that every hypothesis shares.

Every candidate is scored to first order first: the share of the residual above the noise that goes with its
sensitivities and those of the calibrated parameters, within bounds and under priors. The most promising are fitted with
the full simulator. A fit starts from its linear estimate, from multiples of it (a strength is underestimated where
motion has run out of phase), from where other hypotheses have come to rest (their *basins*), and from the best of a
low-discrepancy design over strengths, stiffness and whatever else nothing is known of. All of them are ranked on the
first part of the recording, where phases have not slipped yet, and the best are first fitted to that part.

Then another effect is added to the best set as long as the last one removed what one of two would, at most three; of
every larger set each effect is taken out again and exchanged, from the larger set's basin, so that a pair whose first
half was wrong comes apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import lsq_linear
from scipy.stats import qmc

from physworld.arrays import Array
from physworld.estimation.noise import Split
from physworld.estimation.refit import prior_rows, refit
from physworld.estimation.simulations import Job
from physworld.estimation.unknowns import Unknown, at, bounds_of, starting_at, starts_of
from physworld.estimation.whitening import ScaledWhitener, Whitener
from physworld.trace.candidates import Candidate
from physworld.trace.hypotheses import Hypothesis, Setting, Values
from physworld.trace.left_out import independent
from physworld.trace.posterior import MOST, posterior, removes
from physworld.trace.sensitivity import Response, candidate_responses

_MULTIPLES = (0.3, 3.0, 9.0)  # of a linear estimate
_VARIANTS = 3  # shapes of an effect that are fitted before its best is freed
_DESIGN = 32  # places of the low-discrepancy design
_FOLLOWED = 3  # of all starts, the best on the early frames whose stiffness differs
_EARLY_ITERATIONS = 2  # of each of these, on the early frames
_STIFFNESS = 1.1  # logarithms of the stiffness that it spans, up and down
_EARLY = 0.4  # share of the training frames that it looks at
_LEAST_SHARE = 0.01  # of a strength's bound, where the design begins
WORTH = 0.1  # share of the error above the noise that an effect removes to first order, to be fitted
_QUIET = (
    1.2  # misfit over the noise up to which what is there is small, and a score to first order says enough
)
_HALF = 0.5  # of what the best one promises: what a rival has to promise to be fitted to all frames
_FIRST_OF_TWO = 0.29  # share of the root mean square that goes with one of two effects of the same size
_BASINS = 3  # other hypotheses' optima from which a fit starts
_WORSE = 3.0  # times the best one's squared error above the noise: a fit that is left
_APART = 0.1  # logarithm of the stiffness by which two places are in two basins


@dataclass(frozen=True)
class Screened:
    """A candidate's first-order score against a hypothesis.

    Attributes:
        candidate: which.
        values: linear estimates of all unknowns, by name, in the scale of the search.
        share: of the root mean square residual above the noise that goes, to first order.
        error: mean squared residual over the noise's that stays.
    """

    candidate: Candidate
    values: Values
    share: float
    error: float


@dataclass(frozen=True)
class Begun:
    """Where the fit of a candidate beside a hypothesis begins.

    Attributes:
        screened: its first-order score.
        starts: places, by name, beside the linear estimate.
        promised: share of the root mean square above the noise that goes on the early frames, fitted there.
    """

    screened: Screened
    starts: list[Values]
    promised: float


@dataclass(frozen=True)
class Step:
    """One step of a search: what every candidate scored beside a set of effects, and what was fitted on top of it."""

    base: Hypothesis
    screened: list[Screened]
    tried: tuple[Hypothesis, ...]


@dataclass
class Search:
    """State of a search.

    Attributes:
        setting: what all hypotheses share.
        chosen: candidates.
        early: whitener of the first part of the training frames, and their end; None: no design.
        singles, additions, most: candidates that are fitted first, and on top of a set; effects at most.
        seed: of the designs.
    """

    setting: Setting
    chosen: list[Candidate]
    early: tuple[Whitener, int] | None
    singles: int
    additions: int
    most: int
    seed: int = 0
    hypotheses: dict[tuple[str, ...], Hypothesis] = field(default_factory=dict)
    screens: list[tuple[Hypothesis, list[Screened]]] = field(default_factory=list)

    @property
    def library(self) -> int:
        """Number of effects that are asked."""
        return len({candidate.effect for candidate in self.chosen})

    def run(self, declared: Hypothesis) -> list[Hypothesis]:
        """Hypotheses with their fits, ``declared`` first."""
        simulations = self.setting.simulations
        self.hypotheses[()] = declared
        base = declared
        for size in range(self.most):
            with simulations.time_permitting(
                "sensitivities" if not size else "sensitivities of another effect"
            ):
                self._add(base, self.additions if size else self.singles)
            larger = max(self._of_size(size + 1), key=self._total, default=base)
            if size and self._total(larger) > self._total(base):
                with simulations.time_permitting("fits without one of the effects"):
                    self._take_out(larger)
            known = [h for h in self._of_size(size + 1) if h.doubt is None]
            best = max([h for h in known if self._relevant(h)] or known, key=self._total, default=base)
            pays = best is not base and self._removes(base, best) >= _FIRST_OF_TWO
            if not pays or simulations.ledger.cut:
                break
            base = best
        return list(self.hypotheses.values())

    def admitted(self) -> list[Hypothesis]:
        """Hypotheses of which every effect removes most of what is left above the noise without it, and with an effect
        that it contains in its place; ours is no true twin, and what smaller shares of its error look like is no
        evidence."""
        return [h for h in self.hypotheses.values() if self._relevant(h)]

    def _relevant(self, hypothesis: Hypothesis) -> bool:
        for member in hypothesis.members:
            rest = [other.effect for other in hypothesis.members if other is not member]
            simpler = [self.hypotheses.get(tuple(sorted(rest)), self.hypotheses[()])]
            simpler += [
                h for name in member.contains if (h := self.hypotheses.get(tuple(sorted([*rest, name]))))
            ]
            if any(self._removes(one, hypothesis) < MOST for one in simpler):
                return False
        return True

    def _removes(self, without: Hypothesis, after: Hypothesis | None = None) -> float:
        """Share of what ``without`` leaves that is gone after; all of it for None."""
        return removes(without.left, 0.0 if after is None else after.left)

    @property
    def steps(self) -> tuple[Step, ...]:
        """What was scored and fitted, set by set."""
        found = []
        for base, screened in self.screens:
            tried = (h for h in self.hypotheses.values() if len(h.members) == len(base.members) + 1)
            found.append(Step(base, screened, tuple(h for h in tried if set(base.names) <= set(h.names))))
        return tuple(found)

    def weights(self) -> Array:
        """Posterior of the admitted hypotheses, (H,), in their order."""
        known = self.admitted()
        return posterior([h.unseen for h in known], [self._log_prior(h) for h in known], self.seed)

    def _log_prior(self, hypothesis: Hypothesis) -> float:
        if not hypothesis.members:
            return hypothesis.log_prior
        effects = sum(1 + len(member.contains) for member in hypothesis.members)
        return hypothesis.log_prior - effects * float(np.log(2.0 * self.library))

    def _total(self, hypothesis: Hypothesis) -> float:
        """Log posterior up to a constant, all blocks alike."""
        count = min(self.hypotheses.values(), key=lambda h: h.left).unseen.count
        return self._log_prior(hypothesis) - 0.5 * count * float(np.log(hypothesis.left))

    def _of_size(self, size: int) -> list[Hypothesis]:
        return [h for h in self.hypotheses.values() if len(h.members) == size]

    def _add(self, base: Hypothesis, count: int) -> None:
        """Fits with one effect more than ``base``, if that leaves anything above the noise."""
        nothing = self._removes(base) == 0.0
        if nothing and base.members:
            return
        screened = self.screened(base)
        self.screens.append((base, screened))
        if nothing:
            return
        by_effect: dict[str, list[Screened]] = {}
        for one in screened:
            by_effect.setdefault(one.candidate.effect, []).append(one)
        order = [own for own in by_effect.values() if own[0].share > WORTH]
        restless = base.fitted.misfit > _QUIET and not base.members
        order = order[:count]
        if restless:  # a score to first order says nothing of an effect that is large
            order += [own for own in by_effect.values() if own not in order and own[0].candidate.scanned]
        simpler = [name for own in order for name in own[0].candidate.contains]
        order += [by_effect[name] for name in simpler if name in by_effect and by_effect[name] not in order]
        begun = [self._begun(base, own) for own in order]
        most = max((one.promised for own in begun for one in own), default=0.0)
        scored = max((own[0].share for own in order), default=0.0)
        for own in sorted(begun, key=lambda own: -max(one.promised for one in own)):
            promised, share = max(one.promised for one in own), own[0].screened.share
            if promised >= _HALF * most or share >= _HALF * scored:
                self.setting.simulations.stage = f"fit with {own[0].screened.candidate.effect}"
                self._fit(base, own)
        self._share(len(base.members) + 1)

    def _share(self, size: int) -> None:
        """Fits again from the calibrated numbers of the best one: a material is the same whatever else acts on it, and
        a fit that has come to rest in a valley of its own says nothing of its effect."""
        calibrated = {unknown.name for unknown in self.setting.calibrated}
        ranked = sorted(self._of_size(size), key=lambda h: h.left)
        for known in ranked[1:]:
            shared = {n: v for n, v in ranked[0].values.items() if n in calibrated}
            place = {**known.values, **shared}
            twin, unknowns = self.setting.assembled(known.members, place)
            runs = self.setting.simulations.run(
                [Job(at(twin, unknowns, starts_of(unknowns)), self.setting.frames)]
            )
            if runs[0] is None or np.mean(known.white.residual(runs[0]) ** 2) >= known.fitted.misfit**2:
                continue
            self.setting.simulations.stage = f"fit with {' and '.join(known.names)}"
            found = self.setting.fitted(known.members, place, scale=known.unseen.scale, white=known.white)
            if found is not None and found.left < known.left:
                self.hypotheses[known.names] = found

    def _take_out(self, larger: Hypothesis) -> None:
        """Fits without one of the effects of a set, and with another one in its place, from the set's basin."""
        for member in larger.members:
            rest = tuple(m for m in larger.members if m is not member)
            known = self.hypotheses.get(_names(rest))
            values = larger.values
            again = self.setting.fitted(
                rest, values, [known.values] if known else [], scale=larger.unseen.scale, white=larger.white
            )
            if again is not None and (known is None or again.left < known.left):
                self.hypotheses[_names(rest)] = known = again
            if known is not None and known.members and self._total(known) < self._total(larger):
                self._add(known, self.additions)

    def _begun(self, base: Hypothesis, variants: list[Screened]) -> list[Begun]:
        """Where the fits of an effect begin: of its best variants the one that promises most, where that is known."""
        kept = variants[: _VARIANTS if variants[0].candidate.shapes else 1]
        self.setting.simulations.stage = f"fit with {variants[0].candidate.effect}"
        begun = [self._best_early(base, one, _DESIGN // len(kept)) for one in kept]
        best = max(begun, key=lambda one: one.promised)
        return begun if best.promised == 0.0 else [best]

    def _fit(self, base: Hypothesis, variants: list[Begun]) -> None:
        """Fits ``base`` with an effect more, the variants' shapes first as they are, then free where that promises
        something."""
        candidate = variants[0].screened.candidate
        members = (*base.members, candidate)
        names = _names(members)
        shaped = bool(candidate.shapes)
        hopeless = self._hopeless(base)
        best: Hypothesis | None = None
        for begun in variants:
            own = (*base.members, begun.screened.candidate)
            linear = {**base.values, **begun.screened.values}
            scale = self._scale(base, begun.screened.error)
            found = self.setting.fitted(own, linear, begun.starts, not shaped, scale, hopeless, base.white)
            if found is not None and (best is None or found.left < best.left):
                best = found
        if best is not None and shaped and self._removes(base, best) >= WORTH:
            places = [best.values]
            mirror = best.members[-1].mirror
            if mirror is not None:
                places.append({**best.values, **_mirrored(best, best.members[-1])})
            for place in places:
                found = self.setting.fitted(best.members, place, scale=best.unseen.scale, white=best.white)
                if found is not None and found.left < best.left:
                    best = found
        known = self.hypotheses.get(names)
        if best is not None and (known is None or best.left < known.left):
            self.hypotheses[names] = best

    def _scale(self, base: Hypothesis, error: float) -> float:
        """Deviations of the noise that a sighting counts as at a mean squared residual of ``error``."""
        rows, blocks = len(base.fitted.residual), len(self.setting.blocks)
        return float(np.sqrt(max(error, 1.0) * rows / independent(max(error, 1.0), rows, blocks)))

    def _hopeless(self, base: Hypothesis) -> float:
        """Squared residual above which a fit is left: it is far from removing a half of what ``base`` leaves, and the
        best one of its size does far better."""
        rows = float(len(base.fitted.residual))
        left = min(
            (h.fitted.misfit**2 for h in self._of_size(len(base.members) + 1)), default=base.fitted.misfit**2
        )
        return rows * (1.0 + max(_WORSE * max(left - 1.0, 0.0), 0.5 * (base.fitted.misfit**2 - 1.0)))

    def _starts(self, base: Hypothesis, one: Screened) -> list[Values]:
        """Places to start from beside the linear estimate."""
        gates = [u.name for u in one.candidate.unknowns()]
        linear = {**base.values, **one.values}
        strengths = {name: linear[name] for name in gates}
        starts: list[Values] = [{**base.values, **strengths}]
        starts += [{**linear, **{n: f * s for n, s in strengths.items()}} for f in _MULTIPLES]
        for other in self._basins(base):
            kept = {n: v for n, v in other.values.items() if n in base.values}
            starts += [
                {**base.values, **kept, **{n: f * s for n, s in strengths.items()}} for f in (1.0, 0.3, 3.0)
            ]
        return starts

    def _basins(self, base: Hypothesis) -> list[Hypothesis]:
        """The best hypotheses whose stiffness is another one than that of ``base``."""
        first = self.setting.calibrated[0].name
        found: list[Hypothesis] = []
        for other in sorted(self.hypotheses.values(), key=self._total, reverse=True):
            here = [base.values.get(first, 0.0), *(h.values.get(first, 0.0) for h in found)]
            if other is not base and all(abs(other.values.get(first, 0.0) - t) > _APART for t in here):
                found.append(other)
        return found[:_BASINS]

    def _best_early(self, base: Hypothesis, one: Screened, design: int) -> Begun:
        """The best of all starts on the early frames, among them ``design`` places of a low-discrepancy design, and the
        share of what ``base`` leaves there that goes with it."""
        starts = self._starts(base, one)
        if self.early is None or (base.fitted.misfit <= _QUIET and not base.members):
            return Begun(one, starts, 0.0)
        white, frames = self.early
        members = (*base.members, one.candidate)
        twin, unknowns = self.setting.assembled(members, base.values, shapes=bool(base.members))
        starts += self._designed(one, unknowns, design)
        low, high = bounds_of(unknowns)
        thetas = [np.clip([start.get(u.name, u.start) for u in unknowns], low, high) for start in starts]
        runs = self.setting.simulations.run([Job(at(twin, unknowns, theta), frames) for theta in thetas])
        errors = [np.inf if t is None else float(np.mean(white.residual(t) ** 2)) for t in runs]
        before = float(np.mean(white.residual(base.fitted.tracks[:frames]) ** 2))
        best: list[Values] = []
        for k in self._apart(errors, [start[self.setting.calibrated[0].name] for start in starts]):
            here = starting_at(unknowns, thetas[k])
            scaled = ScaledWhitener(white, self._scale(base, max(errors[k], 1.0)))
            found = refit(self.setting.simulations, scaled, twin, here, frames, _EARLY_ITERATIONS)
            if found is not None:
                errors.append((scaled.scale * found.misfit) ** 2)
                best.append({u.name: float(t) for u, t in zip(found.unknowns, found.theta, strict=True)})
        return Begun(one, best, removes(before, min(errors)))

    @staticmethod
    def _apart(errors: list[float], stiffnesses: list[float]) -> list[int]:
        """The best of all places, no two of them at the same stiffness."""
        found: list[int] = []
        for k in np.argsort(errors):
            if all(abs(stiffnesses[int(k)] - stiffnesses[other]) > _APART for other in found):
                found.append(int(k))
        return found[:_FOLLOWED]

    def _designed(self, one: Screened, unknowns: list[Unknown], count: int) -> list[Values]:
        """A low-discrepancy design over strengths, stiffness, and what else is calibrated of which nothing is known
        beforehand."""
        first, *rest = self.setting.calibrated
        gates = one.candidate.unknowns()
        open_ = [u for u in rest if u.prior is None and u.name not in [gate.name for gate in gates]]
        drawn = qmc.Sobol(1 + len(open_) + len(gates), seed=self.seed).random_base2(int(np.log2(count)))
        places: list[Values] = []
        for row in drawn:
            place = {u.name: u.start for u in unknowns}
            place[first.name] += _STIFFNESS * (2.0 * row[0] - 1.0)
            for share, unknown in zip(row[1:], open_, strict=False):
                low, high = unknown.bounds
                place[unknown.name] = low + share * (high - low)
            for share, gate in zip(row[1 + len(open_) :], gates, strict=True):
                lowest, highest = gate.bounds
                signed = 2.0 * float(share) - 1.0 if lowest < 0 else float(share)
                size = _LEAST_SHARE ** (1.0 - abs(signed))
                place[gate.name] = float(np.sign(signed) * size * (highest if signed > 0 else -lowest))
            places.append(place)
        return places

    def screened(self, base: Hypothesis) -> list[Screened]:
        """First-order scores of all candidates that ``base`` has not, best first."""
        setting = self.setting
        chosen = [c for c in self.chosen if c.effect not in base.names]
        responses = candidate_responses(
            setting.simulations, base.white, base.fitted.twin, base.fitted.tracks, chosen, setting.frames
        )
        found = [self._screen(base, response) for response in responses if not response.failed]
        return sorted((one for one in found if one is not None), key=lambda one: -one.share)

    def _screen(self, base: Hypothesis, response: Response) -> Screened | None:
        candidate, columns = response.candidate, response.columns
        if not np.any(columns):
            return None
        gates = candidate.unknowns()
        freed = {gate.name for gate in gates}
        kept = [k for k, u in enumerate(base.fitted.unknowns) if u.name not in freed]
        known = [base.fitted.unknowns[k] for k in kept]
        start = np.concatenate([base.fitted.theta[kept], [base.values.get(g.name, 0.0) for g in gates]])
        unknowns = [u.starting(t) for u, t in zip([*known, *gates], start, strict=True)]
        jacobian = np.concatenate([base.fitted.jacobian[:, kept], columns], axis=1)
        change = self._bounded(base, jacobian, unknowns, start)
        error = float(np.mean((base.fitted.residual - jacobian @ change) ** 2))
        share = removes(base.fitted.misfit**2, error)
        values = {u.name: float(t) for u, t in zip(unknowns, start + change, strict=True)}
        return Screened(candidate, values, share, error)

    def _bounded(self, base: Hypothesis, jacobian: Array, unknowns: list[Unknown], start: Array) -> Array:
        """Linear change of all unknowns (p,) within their bounds, by what a sighting counts beside ``base``."""
        slope, residual = jacobian / base.unseen.scale, base.fitted.residual / base.unseen.scale
        prior_residual, prior_slope = prior_rows(unknowns, start)
        normal = slope.T @ slope + prior_slope.T @ prior_slope
        gradient = slope.T @ residual + prior_slope.T @ prior_residual
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        root = np.linalg.cholesky(normal * scale * scale[:, None] + 1e-9 * np.eye(len(scale)))
        low, high = bounds_of(unknowns)
        reach = 0.3 * (high - low)
        low, high = np.maximum(low, start - reach), np.minimum(high, start + reach)
        bounds = np.minimum(low - start, 0.0) / scale, np.maximum(high - start, 1e-12) / scale
        target = np.linalg.solve(root, gradient * scale)
        change: Array = scale * lsq_linear(root.T, target, bounds, method="bvls").x
        return change


def early_part(white: Whitener, split: Split) -> tuple[Whitener, int]:
    """The whitener of the first part of the training frames, and the frame at which that ends."""
    end = split.train[0] + max(int(np.ceil(_EARLY * (split.train[1] - split.train[0]))), 3)
    return white.until(end), end


def _names(members: Sequence[Candidate]) -> tuple[str, ...]:
    return tuple(sorted(member.effect for member in members))


def _mirrored(hypothesis: Hypothesis, member: Candidate) -> dict[str, float]:
    """The mirror image of a member's shape, by name, in the scale of the search."""
    assert member.mirror is not None
    effect = next(e for e in hypothesis.fitted.twin.effects if e.name == member.effect)
    image = member.mirror({name: float(value or 0.0) for name, value in effect.values.items()})
    pairs = zip(member.shape_unknowns(), member.shapes, strict=True)
    return {u.name: u.searched(image[s.name]) for u, s in pairs}
