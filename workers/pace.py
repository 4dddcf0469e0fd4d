"""How much of a shard's work is done, by the stages that its handler goes through."""

from __future__ import annotations

from collections.abc import Mapping

NEARLY = 0.9
"""Of a stage that may end before its budget is spent: what is done when it has spent as much as usual."""


class Pace:
    """Shares of a shard's time by stage, about, and where the work stands."""

    def __init__(self) -> None:
        self._stages: dict[str, tuple[float, float]] = {}
        self._stage = (0.0, 1.0)
        self._usual: float | None = None
        self._share = 0.0

    def plan(self, weights: Mapping[str, float]) -> None:
        """Say which stages follow, in their order, and about how long each takes, in one unit for all."""
        whole = sum(weights.values()) or 1.0
        at = 0.0
        for stage, weight in weights.items():
            self._stages[stage] = (at / whole, (at + weight) / whole)
            at += weight

    def begin(self, stage: str, usual: float | None = None) -> None:
        """The work of a stage of the plan begins. Raises KeyError for one that was not planned.

        Args:
            stage: of the plan.
            usual: with how much done such a stage ends as a rule, where its total is a budget; None: with all of it.
        """
        self._stage, self._usual = self._stages[stage], usual

    def reach(self, done: float, total: float) -> float:
        """Share of the shard that is done at ``done`` of the stage; it never falls."""
        begin, end = self._stage
        part = min(1.0, max(0.0, done / total)) if total > 0 else 0.0
        if self._usual is not None and self._usual < total:
            usual = self._usual / total
            part = (
                NEARLY * part / usual
                if part <= usual
                else 1.0 - (1.0 - NEARLY) * (1.0 - part) / (1.0 - usual)
            )
        self._share = max(self._share, begin + (end - begin) * part)
        return self._share
