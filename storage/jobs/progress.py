"""How much of a whole job is done, and how long it will take yet.

What a shard counts (``done`` of ``total``) is of one stage of its work; ``fraction`` is of the job: the shard's own
share of its work, put into the part of the job that its kind covers (``ShardKind.span``). It never falls,
whatever a later attempt begins with. The time left is the time that the job took so far, for the share of its time that
is left; which that is at which fraction, earlier jobs say (``physworld_storage.jobs.pace``).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

from physworld_schemas.job import Progress

Course = Sequence[Sequence[float]]
"""Pairs of a job's fraction and the share of its whole time in which it was reached, both growing."""

SHORTEST_S = 2.0
SMALLEST = 0.03
"""Of a job's time and of its whole, before which nothing is said of the time left."""


def seconds_left(worked_s: float, share: float) -> float | None:
    """Seconds that what is left will take; None while too little is done to tell.

    Args:
        worked_s: so far [s].
        share: of the whole time that is over, 0 to 1.
    """
    if worked_s < SHORTEST_S or share < SMALLEST:
        return None
    return round(worked_s * (1.0 - share) / share, 1)


def share_of_time(course: Course, fraction: float) -> float:
    """Share of a job's time that is over, 0 to 1, when it comes to a fraction of its work; linear between the pairs."""
    (f0, s0), (f1, s1) = _around(course, fraction)
    return s0 if f1 <= f0 else s0 + (s1 - s0) * (fraction - f0) / (f1 - f0)


def longest_share(course: Course, fraction: float) -> float:
    """Share of a job's time that is over when it leaves a fraction at which it may stand for a while."""
    return _around(course, fraction)[1][1]


def _around(course: Course, fraction: float) -> tuple[Sequence[float], Sequence[float]]:
    """The pairs between which a fraction lies."""
    above = bisect_right(course, fraction, key=lambda pair: pair[0])
    return (
        course[above - 1] if above else (0.0, 0.0),
        course[above] if above < len(course) else (1.0, 1.0),
    )


def of_the_job(reported: Progress, before: Progress, span: tuple[float, float]) -> Progress:
    """What a job tells of a shard's progress, without the time left.

    Args:
        reported: by the shard, of its own work.
        before: what the job told last.
        span: the part of the job that shards of this kind cover.
    """
    begin, end = span
    fraction = max(before.fraction or 0.0, begin + (end - begin) * reported.share)
    return reported.model_copy(update={"fraction": round(min(1.0, fraction), 4), "eta_s": None})
