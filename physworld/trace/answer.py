"""The answer: from the posterior of fitted hypotheses to one honest sentence.

========================  ============================================================================================
``named``                 one set of effects holds 0.95 of the posterior
``equivalent_set``        two to six sets together do: these data cannot tell them apart
``data_issue``            what does are faults of the measurement only
``numerical_issue``       nothing is supported, and finer cells or smaller steps change as much as what is left
``unexplained``           something is there, and no effect of the library removes most of it with support
``nothing_to_explain``    the declared physics is near the noise, and nothing is supported beside it
========================  ============================================================================================

What remains after a named effect is told beside it (``remainder``) and takes no name back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array

if TYPE_CHECKING:
    from physworld.trace.hypotheses import Hypothesis

NAMED, EQUIVALENT, DATA, NUMERICAL = "named", "equivalent_set", "data_issue", "numerical_issue"
UNEXPLAINED, NOTHING = "unexplained", "nothing_to_explain"
SURE = 0.95  # posterior of a name, or of a set
MOST_IN_SET = 6
WITHIN = 1.2  # misfit over the noise up to which nothing is left to explain


@dataclass(frozen=True)
class Verdict:
    """An answer.

    Attributes:
        name: of the verdict.
        model: what is added; the declared physics where nothing is.
        equivalent: hypotheses that do as well.
        reason: one sentence for people.
    """

    name: str
    model: Hypothesis
    equivalent: tuple[Hypothesis, ...] = ()
    reason: str = ""

    @property
    def added(self) -> Hypothesis | None:
        """What a twin is given to predict with: what is named, or the best of an equivalent set.

        The hypotheses of a set predict the same as far as the data tell, so the best one is better than none. A fault
        of the measurement is nothing that a body carries.
        """
        physical = any(member.kind != "measurement" for member in self.model.members)
        return self.model if self.name in (NAMED, EQUIVALENT) and physical else None


def decided(
    known: list[Hypothesis], weights: Array, sigma: float | None, solver: float, tried: int
) -> Verdict:
    """The answer that a posterior gives.

    Args:
        known: hypotheses, the declared physics first.
        weights: their posterior, (H,).
        sigma: noise [m]; None where it is not known.
        solver: root mean squared change by finer cells and smaller steps, over the noise.
        tried: effects that were asked.
    """
    declared, before = known[0], known[0].fitted.misfit
    if sigma is None:
        return Verdict(UNEXPLAINED, declared, (), "no noise estimate, no claim")
    order = [int(k) for k in np.argsort(-weights)]
    enough = int(np.searchsorted(np.cumsum(weights[order]), SURE)) + 1
    chosen = [known[k] for k in order[: min(enough, MOST_IN_SET)]]
    best = chosen[0]
    if declared in chosen:
        if before <= WITHIN:
            reason = f"misfit {before:.2f} of the noise; {tried} effects tried"
            return Verdict(NOTHING, declared, (), reason)
        if before**2 - 1.0 <= solver**2:
            reason = (
                f"misfit {before:.2f} of the noise; finer cells and smaller steps change {solver:.2f} of it"
            )
            return Verdict(NUMERICAL, declared, (), reason)
        reason = f"misfit {before:.2f} of the noise; no effect is supported"
        return Verdict(UNEXPLAINED, declared, (), reason)
    what = " and ".join(best.names)
    figures = f"misfit {before:.2f} to {best.fitted.misfit:.2f} of the noise"
    if enough > MOST_IN_SET:
        reason = f"{what} is the best of {tried} with a posterior of {weights[order[0]]:.2f}; {figures}"
        return Verdict(UNEXPLAINED, declared, (), reason)
    if best.doubt is not None:  # something is there that looks like it: the next name would be a wrong one
        return Verdict(UNEXPLAINED, declared, (), f"{what} predicts best, but {best.doubt}; {figures}")
    chosen = [h for h in chosen if h.doubt is None]
    rest = tuple(chosen[1:])
    if all(member.kind == "measurement" for h in chosen for member in h.members):
        return Verdict(DATA, best, rest, f"{what}, a fault of the data; {figures}")
    if rest:
        others = ", ".join(" and ".join(h.names) for h in rest)
        return Verdict(EQUIVALENT, best, rest, f"{what} or {others}; {figures}")
    reason = f"{what}: posterior {weights[order[0]]:.3f} among {tried} effects; {figures}"
    return Verdict(NAMED, best, (), reason)
