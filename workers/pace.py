"""How much of a shard's work is done, and how long it will take yet, by the stages that its handler goes through."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from physworld_storage.jobs.progress import seconds_left


class Pace:
    """Shares of a shard's time by stage, where the work stands, and the time left at its pace.

    Args:
        clock: monotonic [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._stages: dict[str, tuple[float, float]] = {}
        self._stage = (0.0, 1.0)
        self._anchor: tuple[float, float] | None = None
        self._share = 0.0

    def plan(self, weights: Mapping[str, float]) -> None:
        """Say which stages follow, in their order, and about how long each takes, in one unit for all."""
        whole = sum(weights.values()) or 1.0
        at = 0.0
        for stage, weight in weights.items():
            self._stages[stage] = (at / whole, (at + weight) / whole)
            at += weight

    def begin(self, stage: str) -> None:
        """The work of a stage of the plan begins. Raises KeyError for one that was not planned."""
        self._stage = self._stages[stage]

    def reach(self, done: float, total: float) -> tuple[float, float | None]:
        """Share of the shard that is done, and seconds left (None: too early to tell), at ``done`` of the stage.

        The time counts from the first thing that was done: what an earlier attempt had reached is not its doing.
        """
        begin, end = self._stage
        part = min(1.0, max(0.0, done / total)) if total > 0 else 0.0
        self._share = max(self._share, begin + (end - begin) * part)
        if self._anchor is None:
            if done > 0:
                self._anchor = (self._clock(), self._share)
            return self._share, None
        since, begun = self._anchor
        return self._share, seconds_left(self._clock() - since, self._share, begun)
