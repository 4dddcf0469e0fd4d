"""The winner on finer cells: its effect has to help there too, and to do the same.

Where finer cells change the twin by more than the effect explains, coarse ones are no judge of which effect it is: what
is no better than a part of their error may go to any name. Then its rivals are asked there too.

Sensitivities hardly change with the cells, so those of the coarser ones serve the refit: a few fine simulations do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.estimation.refit import Refit, refit
from physworld.estimation.simulations import Job, Simulations
from physworld.estimation.whitening import Whitener
from physworld.trace.candidates import Candidate
from physworld.trace.comparison import better_beyond_chance, cross_validated
from physworld.trace.config import TraceConfig
from physworld.trace.confirm import Model
from physworld.trace.intervals import spread_of
from physworld.trace.result import Number
from physworld.trace.score import orthonormal, project
from physworld.trace.sensitivity import refinement_of
from physworld.trace.unknowns import with_strengths
from physworld.trace.verdict import accounts, as_good, simplest_first
from physworld.twin.twin import Twin

Values = dict[tuple[str, ...], dict[str, float]]
_AGREEMENT = 0.25  # share by which what an effect does may move with the resolution
_AT_LEAST = 0.5  # share of a strength that finer cells must leave, however wide its interval
_FINER_STEPS = 3  # of the refit on finer cells


@dataclass(frozen=True)
class SecondResolution:
    """The check of one trace: as :class:`physworld.trace.selection.Selection`, and the twin on finer cells.

    Attributes:
        finer: the declared physics there.
        cells: by how many times the noise these cells change it, beside what re-tuning can do.
    """

    simulations: Simulations
    white: Whitener
    block_of_row: Array
    frames: int
    config: TraceConfig
    finer: Twin
    cells: float = 0.0

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
                agreement[model.names] = self._agrees(
                    declared, model, self._rivals(declared, model, real), values
                )
            if agreement.get(model.names, True) or declared.fitted.misfit <= self.config.acceptable:
                break
        return values, agreement

    def _rivals(self, declared: Model, model: Model, real: list[Model]) -> list[Model]:
        """Other effects that may be claimed, if the cells change more than this one explains."""
        explained = np.sqrt(max(declared.fitted.misfit**2 - model.fitted.misfit**2, 0.0))
        others = [m for m in real if len(m.members) <= len(model.members) and m.names != model.names]
        return sorted(others, key=lambda m: m.validated.mean) if self.cells > explained else []

    def _agrees(self, declared: Model, model: Model, rivals: list[Model], values: Values) -> bool:
        """Whether a model does the same on the finer cells, and none of the rivals is better there.

        Its numbers there go into ``values``.
        """
        found = self._there(model)
        if found is None:
            return False
        values[model.names] = {unknown.name: found.value(unknown.name) for unknown in found.unknowns}
        config = self.config
        known = spread_of(model.fitted, self.block_of_row, {}, config.bootstraps, config.seed).numbers()
        plain = self._there(declared)
        return (
            plain is not None
            and self._still_helps(plain, found)
            and all(
                self.does_the_same(model.fitted, found, member)
                or _within(model.fitted, values[model.names], known, member)
                for member in model.members
            )
            and not any(self._better(rival, model, found, plain) for rival in rivals)
        )

    def _there(self, model: Model) -> Refit | None:
        """A model refitted on the finer cells; None if it cannot be simulated there."""
        return refit(
            self.simulations, self.white, refinement_of(model.fitted.twin, self.finer), model.fitted.unknowns,
            self.frames, _FINER_STEPS, jacobian=model.fitted.jacobian,
        )  # fmt: skip

    def _better(self, rival: Model, model: Model, fine: Refit, plain: Refit) -> bool:
        """Whether a rival predicts left-out blocks better on the finer cells, and the model not as well."""
        found = self._there(rival)
        if found is None or found.misfit > fine.misfit:
            return False
        other, own, declared = (
            Model(members, fitted, cross_validated(fitted, self.block_of_row))
            for members, fitted in ((rival.members, found), (model.members, fine), ((), plain))
        )
        return other.validated.mean < own.validated.mean and not as_good(own, other, declared)

    def holds_beside(self, single: Model, pair: Model, values: Values) -> bool:
        """Whether a pair predicts better than the single effect on finer cells too, by the same strengths.

        Its numbers there go into ``values``.
        """
        alone, both = self._there(single), self._there(pair)
        if alone is None or both is None:
            return False
        values[pair.names] = {unknown.name: both.value(unknown.name) for unknown in both.unknowns}
        before, after = (cross_validated(fitted, self.block_of_row) for fitted in (alone, both))
        gates = [unknown.name for member in pair.members for unknown in member.unknowns()]
        return better_beyond_chance(after, before) and all(
            abs(both.value(name) - pair.fitted.value(name)) <= _AGREEMENT * abs(pair.fitted.value(name))
            for name in gates
        )

    def _still_helps(self, plain: Refit, fine: Refit) -> bool:
        """Whether the effect fits and predicts better on finer cells too than the declared physics there.

        Errors on left-out blocks are to first order, and where a few steps with the sensitivities of other cells lead
        nowhere they are not those of any twin.
        """
        before, after = (cross_validated(fitted, self.block_of_row) for fitted in (plain, fine))
        share = 1.0 - after.mean / before.mean
        return (
            fine.misfit < plain.misfit
            and better_beyond_chance(after, before)
            and share >= self.config.material_share
        )

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


def _moved(coarse: Array, fine: Array) -> float:
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
