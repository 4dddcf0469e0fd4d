"""Simulations of a trace, counted and remembered.

What was run is remembered under the job's fingerprint, so a trace that was cut off and starts again with the same
memory goes on where it was.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from physworld.arrays import Array
from physworld.errors import Cancelled
from physworld.estimation.simulations import Drive, Job, Runner, in_turn

Progress = Callable[[int, int, str], None]


class Memory:
    """Tracks by fingerprint, in a folder if one is given."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder, self._known = folder, {}  # type: ignore[var-annotated]
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def get(self, key: str) -> tuple[bool, Array | None]:
        """Whether the run is known, and its tracks."""
        if key in self._known:
            return True, self._known[key]
        if self._folder is None or not (self._folder / f"{key}.npy").exists():
            return False, None
        try:
            tracks = np.load(self._folder / f"{key}.npy", allow_pickle=False)
        except (OSError, ValueError, EOFError):  # cut off while it was written
            return False, None
        return True, tracks if tracks.size else None

    def put(self, key: str, tracks: Array | None) -> None:
        """Remember a run; one that failed as an empty array."""
        if self._folder is None:
            self._known[key] = tracks
            return
        part = self._folder / f"{key}.part.npy"
        np.save(part, np.empty(0) if tracks is None else tracks, allow_pickle=False)
        part.replace(self._folder / f"{key}.npy")


class TimeUp(Exception):
    """The time for what is being searched is up; raised by a run, caught by :meth:`Simulations.time_permitting`."""


@dataclass
class Ledger:
    """What the stages of a trace have cost, and until when it searches.

    Attributes:
        spent: runs that were not remembered and their seconds, by stage.
        ends_at: by ``time.perf_counter``.
        cut: searches that ended before they were through, or did not begin.
    """

    spent: dict[str, tuple[int, float]] = field(default_factory=dict)
    ends_at: float = float("inf")
    cut: list[str] = field(default_factory=list)

    def add(self, stage: str, runs: int, seconds: float) -> None:
        """Add to what a stage has cost."""
        before = self.spent.get(stage, (0, 0.0))
        self.spent[stage] = (before[0] + runs, before[1] + seconds)


class Simulations:
    """Counts, remembers, reports and stops.

    Attributes:
        count: runs asked for, those remembered included.
        stage: what they are for.
        least_step_s: a twin that needs a smaller time step is not run.
        ledger: what stages cost, and until when they may go on.
    """

    def __init__(
        self,
        drive: Drive,
        runner: Runner = in_turn,
        memory: Memory | None = None,
        progress: Progress | None = None,
        cancelled: Callable[[], bool] | None = None,
    ) -> None:
        self.drive, self.count = drive, 0
        self._runner, self._memory = runner, memory or Memory()
        self._progress, self._cancelled = progress, cancelled
        self.stage, self.least_step_s, self.ledger = "", 0.0, Ledger()

    @contextmanager
    def time_permitting(self, stage: str) -> Iterator[None]:
        """A search that is left where time is up, and then is in ``ledger.cut``; ``stage``: what it is for."""
        self.stage = stage
        try:
            yield
        except TimeUp:
            self.ledger.cut.append(stage)

    def run(self, jobs: Sequence[Job]) -> list[Array | None]:
        """Tracks of every job. Raises Cancelled, TimeUp."""
        return self.under(self.drive, jobs)

    def under(self, drive: Drive, jobs: Sequence[Job]) -> list[Array | None]:
        """Tracks of every job under this drive. Raises Cancelled, TimeUp."""
        digest = drive.digest()
        keys = [job.fingerprint(digest) for job in jobs]
        known = [self._memory.get(key) for key in keys]
        missing = [k for k, (found, _) in enumerate(known) if not found]
        tracks = [found for _, found in known]
        self.count += len(jobs) - len(missing)
        waiting = [replace(jobs[k], least_step_s=self.least_step_s) for k in missing]
        if missing:
            self._poll()
        fresh = self._runner(waiting, drive, self._poll) if missing else iter(())
        for k, made in zip(missing, self._timed(fresh), strict=True):
            self._memory.put(keys[k], made)
            tracks[k] = made
            self.count += 1
            if self._progress is not None:
                self._progress(self.count, 0, self.stage)
        return tracks

    def _timed(self, fresh: Iterator[Array | None]) -> Iterator[Array | None]:
        """The same, with its seconds in the ledger."""
        begun = time.perf_counter()
        for made in fresh:
            now = time.perf_counter()
            self.ledger.add(self.stage, 1, now - begun)
            yield made
            begun = time.perf_counter()

    def elsewhere(self, drive: Drive) -> Simulations:
        """Simulations under another drive, with the same runner, memory and watchers; their count goes on from here."""
        other = Simulations(drive, self._runner, self._memory, self._progress, self._cancelled)
        other.count, other.stage, other.least_step_s = self.count, self.stage, self.least_step_s
        other.ledger = self.ledger
        return other

    def _poll(self) -> None:
        if time.perf_counter() > self.ledger.ends_at:
            raise TimeUp(f"after {self.count} simulations in the stage {self.stage!r}")
        if self._cancelled is not None and self._cancelled():
            raise Cancelled(f"trace cancelled after {self.count} simulations in the stage {self.stage!r}")
