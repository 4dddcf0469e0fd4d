"""One search over sets of effects: forward additions, backward deletions, starts that every hypothesis shares.

Every candidate is scored to first order first (:mod:`physworld.trace.screening`). The most promising are fitted with
the full simulator from the best of their near starts (:mod:`physworld.trace.starts`). Where one of them comes near the
noise, the stiffness that it has found is right and no other basin is looked for. Where none does, all are begun far
away too. What is strong promises little to first order: beside the material of the best of these fits the strengths of
all others are tried over their range.

Then another effect is added to the best set as long as the last one removed what one of two would, at most three; of
every larger set each effect is taken out again and exchanged, from the larger set's basin, so that a pair whose first
half was wrong comes apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from physworld.arrays import Array
from physworld.trace.candidates import Candidate
from physworld.trace.hypotheses import Hypothesis, Setting, Values
from physworld.trace.posterior import MOST, posterior, removes
from physworld.trace.screening import Screened, screened
from physworld.trace.starts import NO_WORSE, Begun, Starts, distinct, elsewhere

_VARIANTS = 3  # shapes of an effect that are begun before its best is freed
WORTH = 0.1  # share of the error near the noise that an effect removes to first order, to be fitted
_QUIET = 1.2  # misfit over the noise up to which what is left is small, and calibrated numbers are right
_HALF = 0.5  # of what the best one promises: what a rival has to promise to be fitted to all frames
_FIRST_OF_TWO = 0.29  # share of the root mean square that goes with one of two effects of the same size
_BASINS = 3  # other hypotheses' optima from which a fit starts
_MULTIPLES = (1.0, 0.3, 3.0)  # of its strengths, where an effect is tried with the material of the best one
_WORSE = 3.0  # times the best one's squared error above the noise: a fit that is left


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
        starts: where fits begin.
        singles, additions, most: candidates that are fitted first, and on top of a set; effects at most.
        hypotheses: that were fitted, by their effects.
        screens: what was scored beside which of them.
        settled: errors that the sets of a size had when they were last fitted from each other's numbers.
    """

    setting: Setting
    chosen: list[Candidate]
    starts: Starts
    singles: int
    additions: int
    most: int
    seed: int = 0
    hypotheses: dict[tuple[str, ...], Hypothesis] = field(default_factory=dict)
    screens: list[tuple[Hypothesis, list[Screened]]] = field(default_factory=list)
    settled: dict[int, list[float]] = field(default_factory=dict)

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
        for base, scores in self.screens:
            tried = (h for h in self.hypotheses.values() if len(h.members) == len(base.members) + 1)
            found.append(Step(base, scores, tuple(h for h in tried if set(base.names) <= set(h.names))))
        return tuple(found)

    def weights(self) -> Array:
        """Posterior of the admitted hypotheses, (H,), in their order."""
        known = self.admitted()
        return posterior([h.unseen for h in known], [self._log_prior(h) for h in known], self.seed)

    def _log_prior(self, hypothesis: Hypothesis) -> float:
        if not hypothesis.members:
            return hypothesis.log_prior
        odds = [m.odds / (2.0 * self.library) ** (1 + len(m.contains)) for m in hypothesis.members]
        return hypothesis.log_prior + float(np.log(odds).sum())

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
        scores = screened(self.setting, base, self.chosen)
        self.screens.append((base, scores))
        if nothing:
            return
        order, size = self._worth(base, scores, count), len(base.members) + 1
        self._begin(base, order, far=False)
        if not base.members and not any(_near(known) for known in [base, *self._of_size(size)]):
            self._begin(base, order, far=True)
        self._settle(size)
        if self._scan(base, scores):
            self._settle(size)

    def _worth(self, base: Hypothesis, scores: Sequence[Screened], count: int) -> list[list[Screened]]:
        """The variants of the effects that are asked beside ``base``, the most promising first: of every effect where
        the declared physics leaves much, for a score to first order says little of what is large."""
        by_effect: dict[str, list[Screened]] = {}
        for one in scores:
            by_effect.setdefault(one.candidate.effect, []).append(one)
        order = [own for own in by_effect.values() if own[0].share > WORTH or not _near(base)]
        if _near(base) or base.members:
            order = order[:count]
        simpler = [name for own in order for name in own[0].candidate.contains]
        return order + [
            by_effect[name] for name in simpler if name in by_effect and by_effect[name] not in order
        ]

    def _begin(self, base: Hypothesis, order: Sequence[list[Screened]], far: bool) -> None:
        """Fits of ``base`` with each of the effects: all where little is left, for the fits are cheap and shares of it
        are small differences; else those that promise at least half of what the best one does."""
        begun = [self._begun(base, own, far) for own in order]
        most = max((one.promised for one in begun), default=0.0)
        if far:
            begun = [self.starts.followed(base, one, one.promised >= _HALF * most) for one in begun]
            most = max((one.promised for one in begun), default=0.0)
        scored = max((one.screened.share for one in begun), default=0.0)
        for one in sorted(begun, key=lambda one: -one.promised):
            known = self.hypotheses.get(_names((*base.members, one.screened.candidate)))
            if far and known is not None and one.promised <= self.starts.promised(base, known):
                continue
            scores = not far and one.screened.share >= _HALF * scored
            if scores or one.promised >= _HALF * most > 0.0 or _near(base):
                self.setting.simulations.stage = f"fit with {one.screened.candidate.effect}"
                self._fit(base, one)

    def _scan(self, base: Hypothesis, scores: Sequence[Screened]) -> bool:
        """Fits what promised too little beside a wrong material and does beside that of the best fit; whether any."""
        best = min(self._of_size(len(base.members) + 1), key=lambda h: h.left, default=None)
        if best is None or _near(base) or self._removes(base, best) < MOST:
            return False
        wanted = _HALF * self.starts.promised(base, best)
        missing: dict[str, list[Begun]] = {}
        for one in scores:
            if _names((*base.members, one.candidate)) not in self.hypotheses:
                self.setting.simulations.stage = f"fit with {one.candidate.effect}"
                tried = missing.setdefault(one.candidate.effect, [])
                if len(tried) < _VARIANTS:
                    tried.append(self.starts.scanned(base, one, best))
        begun = [max(tried, key=lambda known: known.promised) for tried in missing.values()]
        chosen = [known for known in begun if known.promised >= wanted]
        for choice in chosen:
            self._fit(base, choice)
        return bool(chosen)

    def _begun(self, base: Hypothesis, variants: list[Screened], far: bool) -> Begun:
        """Where the fit of an effect begins: of its best variants the one that promises most."""
        kept = variants[: _VARIANTS if variants[0].candidate.shapes else 1]
        self.setting.simulations.stage = f"fit with {variants[0].candidate.effect}"
        best = sorted(self.hypotheses.values(), key=self._total, reverse=True)
        first = self.setting.calibrated[0].name
        other = distinct([h.values.get(first, 0.0) for h in best], [base.values.get(first, 0.0)])
        others = [best[k] for k in other][:_BASINS]
        begun = [self.starts.begun(base, one, others, far / len(kept)) for one in kept]
        return max(begun, key=lambda one: one.promised)

    def _settle(self, size: int) -> None:
        """Fits the best set of a size from elsewhere too, and all others and the declared physics from its calibrated
        numbers: a material is the same whatever else acts on it, and a fit in a valley of its own says nothing."""
        ranked = sorted(self._of_size(size), key=lambda h: h.left)
        if not ranked or self.settled.get(size) == [h.left for h in ranked]:
            return
        best = ranked[0]
        if size not in self.settled:
            for places in elsewhere(self.setting.calibrated, best.values)[1:]:
                best = self._again(best, places, np.inf)
        shared = {u.name: best.values[u.name] for u in self.setting.calibrated if u.name in best.values}
        for known in [*ranked[1:], self.hypotheses[()]]:
            own = {n: v for n, v in known.values.items() if n not in shared}
            places = [{**shared, **{n: factor * v for n, v in own.items()}} for factor in _MULTIPLES]
            self._again(known, places, NO_WORSE * known.fitted.misfit**2)
        self.settled[size] = sorted(h.left for h in self._of_size(size))

    def _again(self, known: Hypothesis, places: Sequence[Values], most: float) -> Hypothesis:
        """The better one of a hypothesis and its fit from the best of these places, if that has an error below."""
        self.setting.simulations.stage = f"fit with {' and '.join(known.names)}"
        place, error = self.setting.best_of(known.members, places, known.white)
        if error >= most:
            return known
        scale = self.setting.counted(error)
        hopeless = known.fitted.misfit**2 * len(known.fitted.residual)
        found = self.setting.fitted(known.members, place, scale=scale, hopeless=hopeless, white=known.white)
        return self._kept(found) or known

    def _kept(self, found: Hypothesis | None) -> Hypothesis | None:
        """The better one of a fit and what is known of its set."""
        known = None if found is None else self.hypotheses.get(found.names)
        if found is None or (known is not None and known.left <= found.left):
            return known
        self.hypotheses[found.names] = found
        return found

    def _take_out(self, larger: Hypothesis) -> None:
        """Fits without one of the effects of a set, and with another one in its place, from the set's basin."""
        scale, white, declared = larger.unseen.scale, larger.white, self.hypotheses[()]
        for member in larger.members:
            rest = tuple(m for m in larger.members if m is not member)
            known = self.hypotheses.get(_names(rest))
            places = [known.values] if known else []
            found = self.setting.fitted(rest, larger.values, places, True, scale, white=white)
            known = self._kept(found) or known
            if known is None or _near(larger) or self._total(known) >= self._total(larger):
                continue
            if known.members and self._removes(declared, known) >= _FIRST_OF_TWO:
                self._add(known, self.additions)

    def _fit(self, base: Hypothesis, begun: Begun) -> None:
        """Fits ``base`` with an effect more, its shape first as it is, then free where that promises something."""
        candidate, hopeless = begun.screened.candidate, self._hopeless(base)
        members = (*base.members, candidate)
        first, *others = begun.starts
        scale = self.setting.counted(begun.screened.error)
        shaped = bool(candidate.shapes)
        best = self.setting.fitted(members, first, others, not shaped, scale, hopeless, base.white)
        if best is not None and shaped and self._removes(base, best) >= WORTH:
            places = [best.values]
            mirror = best.members[-1].mirror
            if mirror is not None:
                places.append({**best.values, **_mirrored(best, best.members[-1])})
            for place in places:
                found = self.setting.fitted(best.members, place, scale=best.unseen.scale, white=best.white)
                if found is not None and found.left < best.left:
                    best = found
        self._kept(best)

    def _hopeless(self, base: Hypothesis) -> float:
        """Squared residual above which a fit is left: it is far from removing a half of what ``base`` leaves, and the
        best one of its size does far better."""
        rows = float(len(base.fitted.residual))
        left = min(
            (h.fitted.misfit**2 for h in self._of_size(len(base.members) + 1)), default=base.fitted.misfit**2
        )
        return rows * (1.0 + max(_WORSE * max(left - 1.0, 0.0), 0.5 * (base.fitted.misfit**2 - 1.0)))


def _near(known: Hypothesis) -> bool:
    """Whether a hypothesis leaves so little above the noise that its numbers are about right."""
    return known.fitted.misfit <= _QUIET


def _names(members: Sequence[Candidate]) -> tuple[str, ...]:
    return tuple(sorted(member.effect for member in members))


def _mirrored(hypothesis: Hypothesis, member: Candidate) -> dict[str, float]:
    """The mirror image of a member's shape, by name, in the scale of the search."""
    assert member.mirror is not None
    effect = next(e for e in hypothesis.fitted.twin.effects if e.name == member.effect)
    image = member.mirror({name: float(value or 0.0) for name, value in effect.values.items()})
    pairs = zip(member.shape_unknowns(), member.shapes, strict=True)
    return {u.name: u.searched(image[s.name]) for u, s in pairs}
