"""When a shard is lost: how long it waits, and how a shard that kills its worker is told from workers that die.

A shard is *lost* when its lease ran out or its owner is provably dead. That says nothing of the work: machines are
switched off, containers are moved, processes are killed. So losses do not count as failures of the work, and however
many they are they end no job.

A shard that itself kills its worker (memory, a crash in native code) dies at the same place each time. So the rule:
the work is taken to be deadly when it was lost ``ALIKE`` times in a row, by as many workers, without getting further
than before (by more than ``FURTHER`` of its whole), each time after about the same time (the longest at most ``SPREAD``
times the shortest, and ``SLACK_S``, within which renewals do not tell times apart). Workers that are killed at random
die at different places: of ``ALIKE`` kills at uniformly distributed times of ten minutes the chance to be so alike is
below 1 in 1000, if every single attempt is killed and none gets further; work of seconds would have to be hit
``ALIKE`` times within its seconds, with pauses between that grow to a minute.
"""

from __future__ import annotations

from typing import Any

from physworld_schemas.job import Progress
from physworld_storage.tables import ShardRow

ALIKE = 8
FURTHER = 0.01
SPREAD, SLACK_S = 1.5, 2.0
PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0

Loss = dict[str, Any]
"""``owner``, ``ran_s`` (from claim to the last renewal), ``unit`` and ``reached`` (0 to 1) of its last progress."""


def with_this_one(shard: ShardRow) -> list[Loss]:
    """The losses of a running shard since it last got on, the present one last; at most ``ALIKE``."""
    ran_s = 0.0
    if shard.claimed_at is not None and shard.renewed_at is not None:
        ran_s = max(0.0, (shard.renewed_at - shard.claimed_at).total_seconds())
    progress = Progress.model_validate(shard.progress or {})
    loss = {
        "owner": shard.lease_owner,
        "ran_s": round(ran_s, 2),
        "unit": progress.unit,
        "reached": progress.share,
    }
    before = shard.losses or []
    if any(_got_on(earlier, loss) for earlier in before):
        before = []
    return [*before, loss][-ALIKE:]


def pause_s(losses: list[Loss]) -> float:
    """How long the shard waits before it is claimed again [s]: not at all once, then 1, 2, 4 ... 60."""
    return 0.0 if len(losses) < 2 else min(LONGEST_PAUSE_S, PAUSE_S * 2.0 ** (len(losses) - 2))


def deadly(losses: list[Loss]) -> bool:
    """Whether the work itself kills its workers."""
    if len(losses) < ALIKE:
        return False
    times = [loss["ran_s"] for loss in losses]
    return bool(max(times) <= SPREAD * min(times) + SLACK_S)


def told(losses: list[Loss]) -> str:
    """Where and when the work was lost, in words."""
    times = [loss["ran_s"] for loss in losses]
    workers = len({loss["owner"] for loss in losses})
    place = max(loss["reached"] for loss in losses)
    return (
        f"lost {len(losses)} times in a row by {workers} workers, each time after {min(times):.0f} to "
        f"{max(times):.0f} s and no further than {100 * place:.0f} % of its {losses[-1]['unit'] or 'work'}; "
        f"the last worker was {losses[-1]['owner']}"
    )


def _got_on(earlier: Loss, later: Loss) -> bool:
    return bool(later["unit"] != earlier["unit"] or later["reached"] > earlier["reached"] + FURTHER)
