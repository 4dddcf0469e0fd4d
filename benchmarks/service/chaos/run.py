"""One run: start the service, keep it busy, do it harm until enough was killed, let it heal, count."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from benchmarks.service.chaos import ledger, plan
from benchmarks.service.chaos.plan import Fault
from benchmarks.service.chaos.work import Work
from physworld_storage.settings import Settings

LEASE_S = 5.0
WORKING_THREADS = 3
STEP_S = 0.1
WARM_UP_S = 6.0
"""Before the first fault, so that there is something to lose."""
ORPHAN_S = 60.0
"""Age at which a file goes that no row names: so short that under the faults a row could come too late for its file."""
TIDY_S = 30.0


class Deployment(Protocol):
    """What a run needs to know of the service under test."""

    kill_targets: tuple[str, ...]
    lasting: tuple[tuple[str, str], ...]
    url: str
    token: str

    def start(self) -> None:
        """Start it and wait until it serves. Raises CannotRun."""

    def settings(self) -> Settings:
        """How database and store are reached, around every proxy."""

    def ready(self) -> bool:
        """Whether it serves."""

    def mend(self) -> None:
        """Start again what has ended, without waiting."""

    def possible(self, fault: Fault) -> bool:
        """Whether this machine can play such a fault."""

    def kill(self, fault: Fault) -> bool:
        """SIGKILL; False where the target does not run now."""

    def begin(self, fault: Fault) -> Callable[[], None] | None:
        """Begin a fault that lasts; what ends it."""

    def tidy(self) -> None:
        """Let the service's own housekeeping come at once."""

    def end(self) -> None:
        """Stop it."""


class Harm:
    """The faults of a run, one step at a time."""

    def __init__(self, service: Deployment, seed: int, say: Callable[[str], None]) -> None:
        self._service, self._say = service, say
        self._kills = plan.kills(seed, service.kill_targets)
        self._lasting = plan.lasting(seed, service.lasting, LEASE_S)
        self._waiting: list[Fault] = []
        self._kill_at = self._last_at = time.monotonic() + WARM_UP_S
        self._undo_at = 0.0
        self._undo: Callable[[], None] | None = None
        self._next = next(self._lasting)
        self.killed: Counter[str] = Counter()
        self.lasted: Counter[str] = Counter()
        self.skipped: Counter[str] = Counter()

    def step(self) -> None:
        """Whatever is due now."""
        now = time.monotonic()
        if self._undo is not None and now >= self._undo_at:
            self.mend()
        if now >= self._kill_at:
            self._kill(now)
        if self._undo is None and now >= self._last_at:
            self._begin(now)

    def mend(self) -> None:
        """End the fault that lasts."""
        undo, self._undo = self._undo, None
        if undo is not None:
            undo()

    def _kill(self, now: float) -> None:
        """The first fault of the round whose target runs; a round is drawn when the last one is done."""
        if not self._waiting:
            self._waiting = [next(self._kills) for _ in self._service.kill_targets]
        for fault in self._waiting:
            if self._service.kill(fault):
                self._say(f"killed {fault.target}")
                self._waiting.remove(fault)
                self.killed[fault.target] += 1
                self._kill_at = now + fault.pause_s
                return

    def _begin(self, now: float) -> None:
        fault, self._next = self._next, next(self._lasting)
        self._last_at = now + fault.pause_s
        name = f"{fault.kind} {fault.target}" if fault.target != "all" else fault.kind
        self._undo = self._service.begin(fault) if self._service.possible(fault) else None
        if self._undo is None:
            self.skipped[name] += 1
            return
        self.lasted[name] += 1
        self._undo_at = now + fault.seconds
        self._last_at += fault.seconds
        self._say(f"{name} for {fault.seconds:.1f} s")


def run(
    service: Deployment,
    folder: Path,
    *,
    kills: int,
    seed: int,
    minutes: float,
    episodes: int,
    settle_s: float,
) -> dict[str, Any]:
    """The ledger of a run. Raises CannotRun where the service cannot be started here."""
    began = time.monotonic()

    def say(text: str) -> None:
        print(f"{time.monotonic() - began:7.1f} s  {text}", file=sys.stderr, flush=True)

    try:
        service.start()
        say("the service is ready")
        work = Work(folder, service.url, service.token, episodes)
        work.start(WORKING_THREADS)
        harm = Harm(service, seed, say)
        while sum(harm.killed.values()) < kills and time.monotonic() - began < 60.0 * minutes:
            harm.step()
            service.mend()
            time.sleep(STEP_S)
        harm.mend()
        harmed_s = time.monotonic() - began
        say(f"no more faults after {sum(harm.killed.values())} kills; waiting for what was begun")
        finisher = _Finisher(work, settle_s)
        while finisher.running:
            service.mend()
            time.sleep(STEP_S)
        _let_go_on(service, ORPHAN_S)
        service.tidy()
        _let_go_on(service, TIDY_S)
        say("counting")
        found = ledger.count(service.settings(), work.asked, episodes)
    finally:
        service.end()
    return {
        "seed": seed,
        "kills": sum(harm.killed.values()),
        "kills_wanted": kills,
        "kills_by_target": dict(harm.killed),
        "faults": dict(harm.lasted),
        "skipped": dict(harm.skipped),
        **found,
        "harmed_s": round(harmed_s, 1),
        "seconds": round(time.monotonic() - began, 1),
    }


def _let_go_on(service: Deployment, seconds: float) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        service.mend()
        time.sleep(STEP_S)


class _Finisher:
    """Waits for the work beside the loop that keeps the service running."""

    def __init__(self, work: Work, seconds: float) -> None:
        self._thread = threading.Thread(target=work.finish, args=(seconds,), daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether it still waits."""
        return self._thread.is_alive()
