"""A second effect that hides behind the one that was found, because the two do nearly the same.

Where a drag and a viscosity act, a drag alone may reach the noise: its strength takes the viscosity's part, and what
then remains is less than what the cells change, so that no score shows it. But what cells change differs from one
lattice to the other, and what acts does not. So the pair is refitted on both. It is believed where it predicts left-out
blocks better than the single effect beyond chance on both, and where both strengths are the same on both: of a single
effect whose neighbour absorbs what the twin does wrong they are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.trace.comparison import alikeness
from physworld.trace.confirm import Confirmation, Model, beats
from physworld.trace.result import Step
from physworld.trace.score import orthonormal, project
from physworld.trace.second_resolution import SecondResolution, Values
from physworld.trace.selection import Selection
from physworld.trace.sensitivity import Response

_ALIKE = 0.5  # correlation from which on one effect takes enough of another to be complete without it


@dataclass(frozen=True)
class Mixtures:
    """The search of one trace, with its selection and its check on finer cells."""

    selection: Selection
    second: SecondResolution

    def beside(
        self, single: Model, usable: list[Response], values: Values, agreement: dict[tuple[str, ...], bool]
    ) -> Step | None:
        """The step from a single effect that is complete to it and another one, if that is believed; else None.

        Args:
            single: complete, and the same at both resolutions.
            usable: what every candidate does to the prediction of the declared physics.
            values, agreement: of the check at the second resolution; what is found here goes into them.
        """
        member = single.members[-1]
        if single.validated.mean <= 1.0:  # of left-out blocks nothing is left to tell two effects from one
            return None
        if len(single.members) > 1 or not _simple(member.kind, len(member.gates), len(member.shapes)):
            return None
        simulations, config = self.selection.simulations, self.selection.config
        partners = [
            known
            for known in usable
            if known.candidate.effect not in single.names
            and _simple(known.candidate.kind, len(known.candidate.gates), len(known.candidate.shapes))
        ]
        like = [known for known in self.selection.afresh(single, partners) if _alike(single, known)]
        if not like or config.effects_at_most < 2:
            return None
        simulations.stage = "refit of mixtures"
        ranked = self.selection.scored(single, like)
        confirmation = Confirmation(
            simulations, self.selection.white, self.selection.block_of_row, self.selection.frames,
            config.iterations,
        )  # fmt: skip
        columns = {known.candidate.label: known.columns for known in like}
        tried = [
            model
            for score in ranked.ranked
            if np.any(score.strengths) and (model := confirmation.model(single, [score], columns)) is not None
        ]
        # strengths of two that do nearly the same come to rest slowly
        better = [confirmation.further(model) for model in tried if beats(model, single)]
        for model in sorted(better, key=lambda m: m.validated.mean):
            if self.second.holds_beside(single, model, values):
                agreement[model.names] = True
                return Step(single, ranked, tuple(tried), model)
        return None


def _simple(kind: str, gates: int, shapes: int) -> bool:
    """Whether an effect acts on the body and is one number: more of them absorb what is not theirs."""
    return kind != "measurement" and gates == 1 and not shapes


def _alike(single: Model, known: Response) -> bool:
    """Whether an effect does what the single one does, but for what the calibrated parameters can do."""
    fitted = single.fitted
    names = [unknown.name for unknown in fitted.unknowns]
    own = names.index(single.members[-1].unknowns()[0].name)
    basis = orthonormal(np.delete(fitted.jacobian, own, axis=1))
    return alikeness(project(basis, fitted.jacobian[:, own]), project(basis, known.columns[:, 0])) > _ALIKE
