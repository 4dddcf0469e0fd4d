"""The winner on finer cells: its effect has to help there too, and to do the same.

Sensitivities hardly change with the cells, so those of the coarser ones serve the refit: a few fine simulations do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.simulations import Job
from physworld.trace.candidates import Candidate
from physworld.trace.comparison import better_beyond_chance, cross_validated
from physworld.trace.config import TraceConfig
from physworld.trace.confirm import Model
from physworld.trace.intervals import spread_of
from physworld.trace.refit import Refit, refit
from physworld.trace.result import Number
from physworld.trace.score import orthonormal, project
from physworld.trace.sensitivity import refinement_of
from physworld.trace.simulations import Simulations
from physworld.trace.unknowns import with_strengths
from physworld.trace.verdict import accounts, simplest_first
from physworld.trace.whitening import Whitener
from physworld.twin import Twin

Values = dict[tuple[str, ...], dict[str, float]]
_AGREEMENT = 0.25  # share by which what an effect does may move with the resolution
_AT_LEAST = 0.5  # share of a strength that finer cells must leave, however wide its interval
_FINER_STEPS = 3  # of the refit on finer cells


@dataclass(frozen=True)
class SecondResolution:
    """The check of one trace: as :class:`physworld.trace.selection.Selection`, and the twin on finer cells."""

    simulations: Simulations
    white: Whitener
    block_of_row: np.ndarray
    frames: int
    config: TraceConfig
    finer: Twin

    def check(self, declared: Model, real: list[Model]) -> tuple[Values, dict[tuple[str, ...], bool]]:
        """Values of the best of the models that may be claimed, on the finer cells, and whether they agree.

        Where the best one does not, those that do as well are asked in turn until one agrees, if the declared physics
        leaves so much that something has to be there.
        """
        values: Values = {}
        agreement: dict[tuple[str, ...], bool] = {}
        self.simulations.stage = "second resolution"
        # a rod's stages of friction shrink with its cells' cube, and such a run is no reason to doubt the effect
        self.simulations.least_step_s /= self.config.refinement**3
        for model in simplest_first(real, declared):
            if not accounts(model, declared, self.config):
                break
            with self.simulations.time_permitting("second resolution"):
                agreement[model.names] = self._agrees(declared, model, values)
            if agreement.get(model.names, True) or declared.fitted.misfit <= self.config.acceptable:
                break
        return values, agreement

    def _agrees(self, declared: Model, model: Model, values: Values) -> bool:
        """Whether a model does the same on the finer cells; its numbers there go into ``values``."""
        twin = refinement_of(model.fitted.twin, self.finer)
        found = refit(
            self.simulations, self.white, twin, model.fitted.unknowns, self.frames, _FINER_STEPS,
            jacobian=model.fitted.jacobian,
        )  # fmt: skip
        if found is None:
            return False
        values[model.names] = {unknown.name: found.value(unknown.name) for unknown in found.unknowns}
        config = self.config
        known = spread_of(model.fitted, self.block_of_row, {}, config.bootstraps, config.seed).numbers()
        return self._still_helps(declared, found) and all(
            self.does_the_same(model.fitted, found, member)
            or _within(model.fitted, values[model.names], known, member)
            for member in model.members
        )

    def holds_beside(self, single: Model, pair: Model, values: Values) -> bool:
        """Whether a pair predicts better than the single effect on finer cells too, by the same strengths.

        Its numbers there go into ``values``.
        """
        fine = [
            refit(
                self.simulations, self.white, refinement_of(model.fitted.twin, self.finer), model.fitted.unknowns,
                self.frames, _FINER_STEPS, jacobian=model.fitted.jacobian,
            )
            for model in (single, pair)
        ]  # fmt: skip
        alone, both = fine
        if alone is None or both is None:
            return False
        values[pair.names] = {unknown.name: both.value(unknown.name) for unknown in both.unknowns}
        before, after = (cross_validated(fitted, self.block_of_row) for fitted in (alone, both))
        gates = [unknown.name for member in pair.members for unknown in member.unknowns()]
        return better_beyond_chance(after, before) and all(
            abs(both.value(name) - pair.fitted.value(name)) <= _AGREEMENT * abs(pair.fitted.value(name))
            for name in gates
        )

    def _still_helps(self, declared: Model, fine: Refit) -> bool:
        """Whether the effect predicts better on finer cells too, beside the declared physics refitted there."""
        twin = refinement_of(declared.fitted.twin, self.finer)
        plain = refit(
            self.simulations, self.white, twin, declared.fitted.unknowns, self.frames, _FINER_STEPS,
            jacobian=declared.fitted.jacobian,
        )  # fmt: skip
        if plain is None:
            return False
        before, after = (cross_validated(fitted, self.block_of_row) for fitted in (plain, fine))
        share = 1.0 - after.mean / before.mean
        return better_beyond_chance(after, before) and share >= self.config.material_share

    def does_the_same(self, coarse: Refit, fine: Refit, member: Candidate) -> bool:
        """Whether an effect does the same to the prediction at both resolutions, whatever its numbers.

        Two numbers of one effect may make up for each other (a tether's stiffness and its anchor); what they do
        together is what the data see. Nor do they see what the other unknowns absorb of it: a load along a beam is a
        little stiffness and reach of its clamp, and goes from one to the other with the cells. So it is enough that
        what those leave of it is the same.
        """
        silent = {gate.name: 0.0 for gate in member.gates}
        changes = []
        for fitted in (coarse, fine):
            without = with_strengths(fitted.twin, member.effect, silent)
            tracks = self.simulations.run([Job(without, self.frames)])[0]
            if tracks is None:
                return False
            changes.append(self.white.change(fitted.tracks - tracks))
        others = [k for k, u in enumerate(coarse.unknowns) if u.name.split(".")[0] != member.effect]
        absorbed = orthonormal(coarse.jacobian[:, others])
        return (
            _moved(*changes) <= _AGREEMENT or _moved(*(project(absorbed, c) for c in changes)) <= _AGREEMENT
        )


def _moved(coarse: np.ndarray, fine: np.ndarray) -> float:
    """Change of what an effect does, over what it does, both whitened (M,)."""
    return float(np.linalg.norm(fine - coarse) / max(float(np.linalg.norm(coarse)), np.finfo(float).tiny))


def _within(coarse: Refit, finer: dict[str, float], intervals: dict[str, Number], member: Candidate) -> bool:
    """Whether finer cells leave an effect's strengths within their intervals, and most of each."""
    for gate in member.gates:
        name = f"{member.effect}.{gate.name}"
        before, after, interval = coarse.value(name), finer[name], intervals[name].ci95
        if interval is None or abs(after - before) > 0.5 * (interval[1] - interval[0]):
            return False
        if after * before < _AT_LEAST * before**2:
            return False
    return True
