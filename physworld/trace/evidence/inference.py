"""A trace from the calibrated physics to its answer, by evidence (``TraceConfig.method`` "evidence").

1. Noise; whitening by noise, by the points' own places and by what finer cells and a smaller step change (their
   estimated error as one standard deviation, Richardson's for second order).
2. The declared physics under noise and discrepancy; the search over sets of effects; their posterior.
3. The answer: the sets that hold 95 % of the posterior, four at most. What remains is told beside it and forbids no
   name.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.parameters import BENDING_RATIO, TWIST_RATIO
from physworld.calibrate.rod_parameters import LOSSES, lossless, rod_parameters
from physworld.engine.formulations import RODS
from physworld.estimation.noise import noise_sigma
from physworld.estimation.simulations import Job, stage_s
from physworld.estimation.unknowns import LOG, Unknown
from physworld.estimation.whitening import Whitener, whitener
from physworld.trace.candidates import candidates
from physworld.trace.comparison import CrossValidation
from physworld.trace.confirm import Model
from physworld.trace.evidence.discrepancy import discrepancy_of
from physworld.trace.evidence.hypotheses import Hypothesis, Setting
from physworld.trace.evidence.search import Search, early_part
from physworld.trace.held_out import HeldOut, Outcomes
from physworld.trace.preparation import EXPERIMENT, SELECTION, remarks
from physworld.trace.recordings import FITTED, HELD_OUT
from physworld.trace.result import Step, Supported, TraceResult
from physworld.trace.run import _OTHER_STIFFNESSES, _Trace
from physworld.trace.score import Score, Scores
from physworld.trace.sensitivity import numerical_directions
from physworld.trace.unknowns import of_parameter
from physworld.trace.verdict import DATA, EQUIVALENT, NAMED, NOTHING, NUMERICAL, UNEXPLAINED, Verdict

NAMES = 0.95  # posterior of a name, or of a set
MOST_IN_SET = 4
WITHIN = 1.2  # misfit over the noise up to which nothing is left to explain
_SHAPES = (TWIST_RATIO, BENDING_RATIO)
_SLOWEST = 12.0
_THOROUGH = 2
_RICHARDSON = {"finer cells": 2.04, "half the time step": 1.33}  # error over difference, of second order


class Inference(_Trace):
    """State of one trace."""

    def run(self) -> TraceResult:
        config, simulations = self.config, self.simulations
        if self.twin.form is RODS:
            self.twin = lossless(self.twin)  # what a rod loses is an effect here
        simulations.stage = "declared physics"
        simulations.least_step_s = stage_s(self.twin, simulations.drive) / _SLOWEST
        tracks, answers = simulations.first_look(Job(self.twin, self.frames))
        sigma = noise_sigma(self.scene, self.split, tracks)
        scale = sigma or self._rms(tracks) or 1e-3
        bare = whitener(self.scene, self.split, scale, answers)
        simulations.stage = "numerics"
        directions, finer = numerical_directions(
            simulations, self.lead, self.twin, tracks, config.calibration.particle_budget, config.refinement
        )
        numerics = {n: float(np.sqrt(np.mean(bare.change(d) ** 2))) for n, d in directions.items()}
        doubt = [_RICHARDSON[n] * d for n, d in directions.items() if n in _RICHARDSON]
        white = bare.knowing([*self._turns(tracks, scale), *doubt])
        owners = np.concatenate(
            [np.full(r.points.stop - r.points.start, k) for k, r in enumerate(self.recordings.fitted)]
        )
        discrepancy = discrepancy_of(
            white, self.split, self.scene.times, np.nan_to_num(self.scene.points[0]), owners, tracks
        )
        simulations.stage = "declared physics"
        unknowns = self._unknowns()
        setting = Setting(
            simulations, white, discrepancy, self.frames, config.iterations, self.twin, unknowns
        )
        thorough = replace(setting, iterations=_THOROUGH * config.iterations)
        declared = thorough.fitted((), {u.name: u.start for u in unknowns}, _other_places(unknowns))
        if declared is None:
            raise RuntimeError("the calibrated twin cannot be simulated again")
        chosen, refused = candidates(declared.fitted.twin, config.candidates)
        setting = replace(setting, twin=declared.fitted.twin, calibrated=declared.fitted.unknowns)
        search = Search(setting, chosen, early_part(bare, self.split), config.confirmed, 3, 3, config.seed)
        self.clock.start()
        with self.clock.until(SELECTION):
            search.run(declared)
        known = search.admitted()
        weights = search.weights()
        self.notes += remarks(sigma, config.noise_m is not None, numerics)
        verdict = decided(known, weights, sigma, white, numerics, search.library)
        block_of_row = self.split.block_of(white.frame_of_row)
        path = self._path(search, list(search.hypotheses.values()))
        models = {h.names: _model(h) for h in known}
        found = self._result(
            verdict, models[()], white, block_of_row, sigma, path, chosen, refused, numerics, {}
        )
        experiment = None
        with self.clock.until(EXPERIMENT), simulations.time_permitting("experiment"):
            experiment = self._experiment(verdict, white, finer)
        supported = tuple(
            Supported(
                h.names,
                float(w),
                h.fitted.misfit,
                float(np.sqrt(h.left)),
                h.evidence.kappa,
            )
            for w, h in sorted(zip(weights, known, strict=True), key=lambda pair: -pair[0])
        )
        shares = self._shares(verdict, models[()], found.held_out, white, sigma)
        return replace(found, experiment=experiment, supported=supported, shares=shares)

    def _shares(
        self, verdict: Verdict, declared: Model, held_out: HeldOut, white: Whitener, sigma: float | None
    ) -> dict[str, float]:
        """Share of the held-out error that each effect of the answer takes away, by name; together what all take.

        What an effect takes is the error that comes back when it alone is closed, the other numbers as they are.
        """
        model = verdict.model
        if verdict.name in (NOTHING, UNEXPLAINED) or not model.members:
            return {}
        whole = (held_out.before - held_out.after) / held_out.before
        if len(model.members) == 1:
            return {model.names[0]: whole}
        back = {}
        for name in model.names:
            twin = model.fitted.twin
            kept = tuple(e for e in twin.effects if e.name != name)
            without = replace(model, fitted=replace(model.fitted, twin=replace(twin, effects=kept)))
            measured = Outcomes(self.recordings, self.simulations, self.config)
            outcomes = measured.of(declared, without, white, sigma)
            unseen = [o for o in outcomes if o.role == HELD_OUT] or [o for o in outcomes if o.role == FITTED]
            back[name] = max(measured.together(unseen, sigma).after - held_out.after, 0.0)
        total = sum(back.values())
        return {name: whole * part / total if total > 0 else whole / len(back) for name, part in back.items()}

    def _unknowns(self) -> list[Unknown]:
        """What is calibrated beside effects."""
        if self.twin.form is not RODS:
            return self._calibrated_unknowns(self.twin)
        found = rod_parameters(self.lead, self.twin)
        return [of_parameter(p, self.twin, p.prior) for p in found if p.name not in LOSSES]

    def _path(self, search: Search, known: list[Hypothesis]) -> tuple[Step, ...]:
        steps = []
        for base, screened in search.screens:
            ranked = [Score(s.candidate, s.share, np.zeros(0), np.zeros(0), float("nan")) for s in screened]
            tried = tuple(
                _model(h)
                for h in known
                if len(h.members) == len(base.members) + 1 and set(base.names) <= set(h.names)
            )
            steps.append(Step(_model(base), Scores(ranked, 0.0, []), tried, None))
        return tuple(steps)


def decided(
    known: list[Hypothesis],
    weights: Array,
    sigma: float | None,
    white: Whitener,
    numerics: dict[str, float],
    tried: int,
) -> Verdict:
    """The answer that a posterior gives.

    Args:
        known: hypotheses, the declared physics first.
        weights: their posterior, (H,).
        sigma: noise [m]; None where it is not known.
        white: whitener of the training frames.
        numerics: what other cells and steps change, over the noise.
        tried: effects that were asked.
    """
    order = np.argsort(-weights)
    declared = known[0]
    null = _model(declared)
    before = declared.fitted.misfit
    best = known[int(order[0])]
    figures = f"misfit {before:.2f} to {best.fitted.misfit:.2f} of the noise"
    if sigma is None:
        return Verdict(UNEXPLAINED, null, (), "no noise estimate, no claim")
    chosen, total = [], 0.0
    for k in order:
        chosen.append(known[int(k)])
        total += float(weights[k])
        if total >= NAMES or len(chosen) == MOST_IN_SET:
            break
    rest = [h for h in chosen if h.members]
    if declared in chosen or not rest:
        if before <= WITHIN:
            reason = f"misfit {before:.2f} of the noise; {tried} effects tried"
            return Verdict(NOTHING, null, (), reason)
        if declared.evidence.kappa <= white.sigma and numerics.get("finer cells", 0.0) > before:
            reason = f"misfit {before:.2f} of the noise; finer cells change as much"
            return Verdict(NUMERICAL, null, (), reason)
        reason = f"misfit {before:.2f} of the noise; no effect is supported"
        return Verdict(UNEXPLAINED, null, (), reason)
    what = " and ".join(best.names)
    if total < NAMES:
        reason = f"{what} is the best of {tried} with a posterior of {weights[order[0]]:.2f}; {figures}"
        return Verdict(UNEXPLAINED, null, (), reason)
    if best.doubt is not None:  # something is there that looks like it: the next name would be a wrong one
        return Verdict(UNEXPLAINED, null, (), f"{what} predicts best, but {best.doubt}; {figures}")
    rest = [h for h in rest if h.doubt is None]
    kinds = [all(m.kind == "measurement" for m in h.members) for h in rest]
    models = [_model(h) for h in rest]
    if all(kinds):
        return Verdict(DATA, models[0], tuple(models[1:]), f"{what}, a fault of the data; {figures}")
    if len(rest) > 1:
        others = ", ".join(" and ".join(h.names) for h in rest[1:])
        return Verdict(EQUIVALENT, models[0], tuple(models[1:]), f"{what} or {others}; {figures}")
    reason = f"{what}: posterior {weights[order[0]]:.3f} among {tried} effects; {figures}"
    return Verdict(NAMED, models[0], (), reason)


def _other_places(unknowns: list[Unknown]) -> list[dict[str, float]]:
    """Where the declared physics is looked for beside where it was calibrated: over its stiffness, for a phase that has
    slipped by a period is a local minimum; and over that again from the other shapes of its stiffness, one deviation
    of their priors away, which decide in which of these minima it lies.
    """
    own, first = {u.name: u.start for u in unknowns}, unknowns[0].name
    shapes = [u for u in unknowns[1:] if u.prior is not None and u.transform is LOG and u.name in _SHAPES]
    bases = [own, *({**own, u.name: own[u.name] + u.prior[1]} for u in shapes if u.prior is not None)]
    return [{**base, first: own[first] + shift} for base in bases for shift in (*_OTHER_STIFFNESSES, 0.0)]


def _model(hypothesis: Hypothesis) -> Model:
    found = hypothesis.evidence
    return Model(hypothesis.members, hypothesis.fitted, CrossValidation(found.errors, found.sizes))
