"""How much of a whole job is done, and how long it will take yet.

What a shard counts (``done`` of ``total``) is of one stage of its work; ``fraction`` is of the job: the shard's own
share of its work, put into the part of the job that its kind covers (``ShardKind.span``). It never falls,
whatever a later attempt begins with. The time left is the time that the job took so far, for what is left to do.
"""

from __future__ import annotations

from physworld_schemas.job import Progress

SHORTEST_S = 2.0
SMALLEST = 0.01
"""Of a job's time and of its whole, before which nothing is said of the time left."""


def seconds_left(elapsed_s: float, share: float, begun: float = 0.0) -> float | None:
    """Seconds that what is left will take; None while too little is done to tell.

    Args:
        elapsed_s: since the share was ``begun`` [s].
        share: of the whole that is done, 0 to 1.
        begun: share at the beginning of that time: what an earlier attempt had done.
    """
    if elapsed_s < SHORTEST_S or share - begun < SMALLEST:
        return None
    return round(elapsed_s * (1.0 - share) / (share - begun), 1)


def of_the_job(
    reported: Progress, before: Progress, span: tuple[float, float], elapsed_s: float | None
) -> Progress:
    """What a job tells of a shard's progress.

    Args:
        reported: by the shard, of its own work.
        before: what the job told last.
        span: the part of the job that shards of this kind cover.
        elapsed_s: since the job began [s], by which the time left is told where the shard does not; None: not at all.
    """
    begin, end = span
    fraction = max(before.fraction or 0.0, begin + (end - begin) * reported.share)
    left = reported.eta_s
    if left is None and elapsed_s is not None:
        left = seconds_left(elapsed_s, fraction)
    return reported.model_copy(update={"fraction": round(min(1.0, fraction), 4), "eta_s": left})
