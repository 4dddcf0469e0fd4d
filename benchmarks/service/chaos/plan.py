"""Which faults come, in which order and for how long: all of it follows from the seed.

Kills come in rounds: each round kills every kind of part once, in an order of its own. Beside them come faults that
last (a process stopped, a network silent, a disk full, a store that takes no writes, a clock that jumps), in rounds
too, one at a time. When a fault is due and its target does not run at that moment (it was killed a second ago), the
next one of the round goes first, so the order of what really happened also depends on the machine.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

KILL_EVERY_S = (2.0, 8.0)
LASTING_EVERY_S = (2.0, 7.0)
STEPS_S = (-30.0, 30.0)


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        kind: kill, stop, freeze, clock, disk_full or read_only.
        target: which kind of part (worker, pool, broker, ...); "all" of what has no parts.
        pause_s: how long after the one before [s].
        seconds: how long it lasts [s]; 0 for a kill.
        pick: chooses among several of the kind, in [0, 1).
        step_s: of a clock [s].
    """

    kind: str
    target: str
    pause_s: float
    seconds: float = 0.0
    pick: float = 0.0
    step_s: float = 0.0


def kills(seed: int, targets: Sequence[str]) -> Iterator[Fault]:
    """SIGKILLs without end."""
    draw = random.Random(f"{seed}/kills")
    while True:
        for target in draw.sample(targets, len(targets)):
            yield Fault("kill", target, draw.uniform(*KILL_EVERY_S), pick=draw.random())


def lasting(seed: int, kinds: Sequence[tuple[str, str]], lease_s: float) -> Iterator[Fault]:
    """Faults that last, without end; ``kinds`` are pairs (kind, target).

    A stopped process sleeps shorter than its lease or longer, as often one as the other: the first must not be missed
    by anybody, the second wakes up to find that its shard belongs to another.
    """
    draw = random.Random(f"{seed}/lasting")
    while True:
        for kind, target in draw.sample(kinds, len(kinds)):
            if kind == "stop" and draw.random() < 0.5:
                seconds = lease_s * draw.uniform(1.3, 2.0)
            elif kind == "freeze":
                seconds = draw.uniform(2.0, 2.0 * lease_s)
            else:
                seconds = draw.uniform(1.0, 4.0)
            pause_s, pick = draw.uniform(*LASTING_EVERY_S), draw.random()
            yield Fault(kind, target, pause_s, seconds, pick, draw.uniform(*STEPS_S))
