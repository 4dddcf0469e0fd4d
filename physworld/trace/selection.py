"""Forward selection: score, refit the best, keep the simplest that helps, and go on where it leaves too much."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.estimation.simulations import Simulations
from physworld.estimation.whitening import Whitener
from physworld.trace.basins import with_other_basins
from physworld.trace.comparison import alikeness, cross_validated
from physworld.trace.compound import has_parts, in_parts, whole_of
from physworld.trace.config import TraceConfig
from physworld.trace.confirm import Confirmation, Model, as_a_plate, best_variants, explained_direction
from physworld.trace.result import Step
from physworld.trace.score import Score, Scores, orthonormal, project, scores
from physworld.trace.sensitivity import Response, candidate_responses, decoys
from physworld.trace.tethers import with_tethers
from physworld.trace.verdict import as_good, helps, simplest

Search = Callable[[list[Model]], list[Model]]
_OUTDONE = 0.5  # share of what a complete model's effect explains that a rival must explain to be refitted
_LEADING = 2  # models that are refitted from elsewhere
_NEAR = 3.0  # times what the best leaves above the noise
_NEARLY_ALL = 0.1  # share of what there is to explain that such a model may leave
_FAR = 3.0  # misfit over the noise from which on sensitivities are asked again after an effect was added
_CLEARLY = 1.02  # misfit over the best one's from which a model that does the same is worth another search
_ANOTHER_BASIN = 0.25  # logarithm of the stiffness from which on another search is worth it


@dataclass(frozen=True)
class Selection:
    """The selection of one trace: its simulations, whitener, block of every row (M,), training frames, settings."""

    simulations: Simulations
    white: Whitener
    block_of_row: Array
    frames: int
    config: TraceConfig

    def path(self, declared: Model, usable: list[Response]) -> tuple[Step, ...]:
        """The steps from the declared physics; ``usable``: what every candidate does to the prediction."""
        path: list[Step] = []
        config, base = self.config, declared
        confirmation = Confirmation(
            self.simulations, self.white, self.block_of_row, self.frames, config.iterations
        )
        columns = {response.candidate.label: response.columns for response in usable}
        for number in range(config.effects_at_most):
            ranked = self.scored(base, usable)
            least = max(config.material_share, ranked.threshold if number else 0.0)
            hopeful = best_variants(ranked.ranked, least, config.confirmed, base.names)
            if declared.fitted.misfit <= config.near_floor:  # only a score beyond chance calls for an effect
                hopeful = [variants for variants in hopeful if variants[0].share >= ranked.threshold]
            tried = self._singles(confirmation, base, hopeful, columns, ranked)
            for stage, search in self._searches(confirmation, base, ranked, columns, usable)[bool(number) :]:
                with self.simulations.time_permitting(stage):
                    tried = search(tried)
            if number == 1:
                with self.simulations.time_permitting("refit of pairs with another first effect"):
                    tried = self._exchanged(confirmation, declared, base, path[0].tried, tried)
            good = [m for m in tried if helps(m, base, config)]
            kept = simplest(good, base) if good else None
            path.append(Step(base, ranked, tuple(tried), kept))
            if kept is None or kept.fitted.misfit <= config.near_floor or self.simulations.ledger.cut:
                break
            base = kept
            if (
                declared.fitted.misfit > _FAR
            ):  # what the candidates did there says little of what they do here
                with self.simulations.time_permitting("sensitivities of a second effect"):
                    usable = self.afresh(base, usable)
                if self.simulations.ledger.cut:
                    break
                columns = {response.candidate.label: response.columns for response in usable}
        return tuple(path)

    def _singles(
        self,
        confirmation: Confirmation,
        base: Model,
        hopeful: list[list[Score]],
        columns: dict[str, Array],
        ranked: Scores,
    ) -> list[Model]:
        """The base with one more effect, each of the hopeful ones refitted from its linear scores."""
        tried: list[Model] = []
        for variants in hopeful:
            best = min(tried, key=lambda m: m.fitted.misfit, default=None)
            if best is not None and self._outdone(base, best, variants[0], ranked):
                continue
            with self.simulations.time_permitting(f"refit with {variants[0].candidate.effect}"):
                model = confirmation.model(base, variants, columns, best)
                if model is not None:
                    tried.append(model)
        return tried

    def _searches(
        self,
        confirmation: Confirmation,
        base: Model,
        ranked: Scores,
        columns: dict[str, Array],
        usable: list[Response],
    ) -> tuple[tuple[str, Search], ...]:
        """What is done to the models with one more effect, in turn; the first to single effects only."""
        floor = self.config.near_floor
        return (
            ("refit from other basins",
             lambda tried: with_other_basins(confirmation, base, ranked, columns, tried, floor)),
            ("refit of tethers",
             lambda tried: with_tethers(confirmation, base, ranked, columns, usable, tried, floor)),
            ("refit of mirror images", lambda tried: self._mirrored(confirmation, base, tried)),
            ("refit from elsewhere", lambda tried: self._again(confirmation, base, tried, ranked)),
            ("refit of the grips", lambda tried: self._held_otherwise(confirmation, tried)),
            ("refit of the clamps", lambda tried: self._clamped_otherwise(confirmation, tried)),
            ("refit of the like", lambda tried: self._alike(confirmation, base, tried, columns)),
            ("refit from better basins", lambda tried: self._from_better_basins(confirmation, tried)),
            ("refit in parts", lambda tried: [*tried, *self._in_parts(confirmation, base, tried, usable)]),
            ("refit as a plate", lambda tried: self._as_plates(base, tried)),
        )  # fmt: skip

    def afresh(self, base: Model, usable: list[Response]) -> list[Response]:
        """What the candidates do to another model's prediction."""
        chosen = [r.candidate for r in usable if r.candidate.effect not in base.names]
        found = candidate_responses(
            self.simulations, self.white, base.fitted.twin, base.fitted.tracks, chosen, self.frames
        )
        return [response for response in found if not response.failed]

    def _outdone(self, base: Model, best: Model, score: Score, ranked: Scores) -> bool:
        """Whether a model is complete of which an effect explains too little to first order, in whatever shape."""
        if best.fitted.misfit > self.config.near_floor:
            return False
        own = max(s.family for s in ranked.ranked if s.candidate.effect == best.names[-1])
        return score.family < _OUTDONE * own

    def _mirrored(self, confirmation: Confirmation, base: Model, tried: list[Model]) -> list[Model]:
        """Models, those that explain most of what there is refitted from the mirror images of their shapes."""
        worth = max(_OUTDONE * base.explained, _NEAR * min((model.explained for model in tried), default=0.0))
        return [confirmation.mirrored(m) if m.explained <= worth else m for m in tried]

    def _again(
        self, confirmation: Confirmation, base: Model, tried: list[Model], ranked: Scores
    ) -> list[Model]:
        """Models that leave too much, refitted from elsewhere: the best, and simpler ones that scored like them."""
        floor, ordered = self.config.near_floor, sorted(tried, key=lambda m: m.fitted.misfit)
        if not ordered:
            return tried
        share = {s.candidate.effect: s.share for s in reversed(ranked.ranked)}
        best = ordered[0]
        simpler = [
            m
            for m in ordered[1:]
            if len(m.fitted.unknowns) < len(best.fitted.unknowns)
            and share[m.names[-1]] >= _OUTDONE * share[best.names[-1]]
        ]
        leading = ordered[:_LEADING] if best.fitted.misfit > floor else []
        worth = [
            m
            for m in [*leading, *simpler[:_LEADING]]
            if m.fitted.misfit > floor and helps(m, base, self.config)
        ]
        found = {id(m): m for m in tried}
        for m in worth:
            if found[id(m)] is m:
                found[id(m)] = confirmation.elsewhere(m)
        return [found[id(m)] for m in tried]

    def _held_otherwise(self, confirmation: Confirmation, tried: list[Model]) -> list[Model]:
        """Models, those that are near the best refitted from grips that hold otherwise."""
        least = min((model.explained for model in tried), default=0.0)
        return [confirmation.held_otherwise(m) if m.explained <= _NEAR * least else m for m in tried]

    def _clamped_otherwise(self, confirmation: Confirmation, tried: list[Model]) -> list[Model]:
        """Models, the best refitted from other reaches of the clamps where it is complete; the rest of them follow it.

        One that is not has been refitted from elsewhere. A reach of a part of a cell is no smooth unknown, and what
        the declared physics made of it need not be where the effect fits.
        """
        best = min(tried, key=lambda m: m.fitted.misfit, default=None)
        if best is None or best.fitted.misfit > self.config.near_floor:
            return tried
        return [confirmation.clamped_otherwise(m) if m is best else m for m in tried]

    def _in_parts(
        self, confirmation: Confirmation, base: Model, tried: list[Model], usable: list[Response]
    ) -> list[Model]:
        """The effects that one which is their sum may be as well, where it leaves little."""
        found = [
            in_parts(confirmation, base, m, [response.candidate for response in usable])
            for m in tried
            if has_parts(m) and m.fitted.misfit <= self.config.acceptable and helps(m, base, self.config)
        ]
        return [model for model in found if model is not None]

    def _as_plates(self, base: Model, tried: list[Model]) -> list[Model]:
        """Models of sheets without numbers of their own for bending where that does as well.

        Those that are near the best, and those that explain nearly all: with such numbers an effect that does not act
        may come nearer to the noise than the one that does.
        """
        least = min((model.explained for model in tried), default=0.0)
        worth = max(_NEAR * least, _NEARLY_ALL * base.explained)
        found = []
        for model in tried:
            if model.explained <= worth:
                fitted = as_a_plate(
                    model.fitted, self.simulations, self.white, self.frames, self.config.iterations
                )
                if fitted is not None:
                    plate = Model(model.members, fitted, cross_validated(fitted, self.block_of_row))
                    model = plate if as_good(plate, model, base) else model
            found.append(model)
        return found

    def _alike(
        self, confirmation: Confirmation, base: Model, tried: list[Model], columns: dict[str, Array]
    ) -> list[Model]:
        """Models that to first order do what the best does, refitted from where that one fits.

        A lag and a clock that is off do the same; that one search found the better place is no reason to prefer it.
        """
        best = min(tried, key=lambda m: m.fitted.misfit, default=None)
        if best is None:
            return tried
        basis = orthonormal(base.fitted.free_jacobian)
        does = project(basis, columns[best.members[-1].label] @ _strengths(best))
        found = []
        for model in tried:
            own = project(basis, columns[model.members[-1].label])
            like = own.shape[1] == 1 and alikeness(own[:, 0], does) > self.config.alike
            if model is not best and like and model.fitted.misfit > _CLEARLY * best.fitted.misfit:
                strength = float(own[:, 0] @ does) / float(own[:, 0] @ own[:, 0])
                model = confirmation.from_place_of(model, best, strength)
            found.append(model)
        return found

    def _from_better_basins(self, confirmation: Confirmation, tried: list[Model]) -> list[Model]:
        """Models of one strength; those clearly worse than one near the noise are refitted from where that fits.

        Likewise from every complete model in another basin: the best need not be the one that is believed in the end.
        """
        ordered = sorted(tried, key=lambda m: m.fitted.misfit)
        if not ordered or ordered[0].fitted.misfit > self.config.acceptable:
            return tried
        for place in _one_a_basin([ordered[0], *(m for m in ordered[1:] if self._complete(m))]):
            tried = [
                confirmation.beside(m, place)
                if len(m.members[-1].gates) == 1 and m.fitted.misfit > _CLEARLY * place.fitted.misfit
                else m
                for m in tried
            ]
        return tried

    def _complete(self, model: Model) -> bool:
        return model.fitted.misfit <= self.config.near_floor

    def _exchanged(
        self,
        confirmation: Confirmation,
        declared: Model,
        single: Model,
        singles: Sequence[Model],
        tried: list[Model],
    ) -> list[Model]:
        """Pairs; where the best is not complete, with others in the place of its first effect that do the same as it.

        Alone a linear and a quadratic drag do about as well, and which one is nearer depends on what else acts. So what
        was taken first may be the wrong one, and only the pair shows it.
        """
        best = min(tried, key=lambda m: m.fitted.misfit, default=None)
        if best is None or len(best.members) != 2 or self._complete(best):
            return tried
        second = best.members[-1]
        basis = orthonormal(declared.fitted.free_jacobian)
        does = explained_direction(single, declared, basis)
        found = []
        for other in singles:
            if len(other.members) > 1 or other.names[0] in best.names:
                continue
            members = (*other.members, second)
            like = alikeness(explained_direction(other, declared, basis), does) > self.config.alike
            if like and not any(member.shapes for member in members):
                strengths = [other.fitted.value(gate.name) for gate in members[0].unknowns()]
                strengths += [best.fitted.value(gate.name) for gate in second.unknowns()]
                pair = confirmation.together(declared, members, strengths, best)
                found += [pair] if pair is not None else []
        return [*tried, *found]

    def scored(self, base: Model, usable: list[Response]) -> Scores:
        """Scores of the candidates against what a model leaves."""
        config, white = self.config, self.white
        rest = [r for r in usable if r.candidate.effect not in base.names]
        shape = (len(white.visible), white.visible.shape[1])
        fakes = decoys(rest, white, shape, config.decoys, config.seed)
        return scores(
            base.fitted.residual, base.fitted.free_jacobian, rest, fakes, self.block_of_row,
            config.family_wise_level, config.resamples, config.seed,
        )  # fmt: skip


def _one_a_basin(models: list[Model]) -> list[Model]:
    """Models, of those with nearly the same stiffness the first."""
    found: list[Model] = []
    for model in models:
        if all(abs(model.fitted.theta[0] - known.fitted.theta[0]) > _ANOTHER_BASIN for known in found):
            found.append(model)
    return found


def _strengths(model: Model) -> Array:
    """Strengths of the last effect's gates in units of their probes, (k,)."""
    member, known = model.members[-1], model.fitted
    names = [unknown.name for unknown in known.unknowns]
    return np.array([known.theta[names.index(gate.name)] for gate in member.unknowns()])


def by_chance(model: Model, scores: Scores) -> bool:
    """Whether random signs reach the score of every effect of a model, in its best variant; the whole's for parts."""
    whole = whole_of(model)
    names = model.names if whole is None else (*model.names, whole)
    own = [s.share for s in scores.ranked if s.candidate.effect in names]
    return max(own, default=0.0) < scores.threshold
