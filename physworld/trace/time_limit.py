"""The time that a trace is given: searches are left when their part of it is up, and the answer says so.

Calibration, noise and first-order scores are never cut short, for without them there is no answer. What is left of the
limit then, and a quarter of it at least, goes to the selection, the second resolution and the proposed experiment in
turn; what one of them does not need the next one has. A run that is remembered takes no time,
so a trace that resumes goes on where its searches were left.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from physworld.estimation.simulations import Ledger
from physworld.trace.confirm import Model
from physworld.trace.verdict import DATA, EQUIVALENT, NAMED, UNEXPLAINED, Verdict

SELECTION, CONFIRMATION, EXPERIMENT = 0.7, 0.95, 1.0
"""By which share of the time that is left after the scores a part ends."""
_AT_LEAST = 0.25  # share of the limit that the searches have, however long what comes before them took
_SHOWN = 6  # searches that a reason lists


class Clock:
    """Of one trace.

    Args:
        begun: when it began, by ``time.perf_counter``.
        limit_s: see ``TraceConfig.time_limit_s``.
        ledger: of its simulations, whose end this sets.
    """

    def __init__(self, begun: float, limit_s: float | None, ledger: Ledger) -> None:
        self.begun, self.limit_s, self.ledger = begun, limit_s, ledger
        self._from = self._left = 0.0

    def start(self) -> None:
        """The searches begin."""
        if self.limit_s is not None:
            self._from = time.perf_counter()
            self._left = max(self.limit_s - (self._from - self.begun), _AT_LEAST * self.limit_s)

    @contextmanager
    def until(self, share: float) -> Iterator[None]:
        """A part that ends by this share of the time that was left when the searches began."""
        if self.limit_s is not None:
            self.ledger.ends_at = self._from + share * self._left
        try:
            yield
        finally:
            self.ledger.ends_at = float("inf")

    def told(self, verdict: Verdict, declared: Model, agreement: dict[tuple[str, ...], bool]) -> Verdict:
        """The verdict as far as it goes: nothing is named that finer cells were not asked about.

        Args:
            verdict: made of what there is.
            declared: the declared physics.
            agreement: of the models that were asked about, by their names.
        """
        cut = list(dict.fromkeys(self.ledger.cut))
        if not cut:
            return verdict
        more = f" and {len(cut) - _SHOWN} more" if len(cut) > _SHOWN else ""
        left = f"after {self.limit_s:g} s these searches were left: {', '.join(cut[:_SHOWN])}{more}"
        if verdict.name in (NAMED, EQUIVALENT, DATA) and verdict.model.names not in agreement:
            reason = f"time was up before finer cells were asked ({verdict.reason}); {left}"
            return Verdict(UNEXPLAINED, declared, (), reason)
        return replace(verdict, reason=f"{verdict.reason}; {left}")
