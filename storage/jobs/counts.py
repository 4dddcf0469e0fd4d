"""How many jobs and shards are in which state: the figures of the metrics page, three statements."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from physworld_schemas.job import TERMINAL_STATES
from physworld_storage.jobs.opening import QUEUED, STAGE_WINDOW
from physworld_storage.tables import JobRow, ShardRow


def count_jobs(session: Session) -> dict[tuple[str, str], int]:
    """Jobs by (kind, state)."""
    rows = session.execute(
        select(JobRow.kind, JobRow.state, func.count()).group_by(JobRow.kind, JobRow.state)
    )
    return {(kind, state): count for kind, state, count in rows}


def count_shards(session: Session) -> dict[tuple[str, str], int]:
    """Shards by (kind, state); those of a long stage that will be made as it goes on count as queued."""
    rows = session.execute(
        select(ShardRow.kind, ShardRow.state, func.count()).group_by(ShardRow.kind, ShardRow.state)
    )
    counts = {(kind, state): count for kind, state, count in rows}
    made = (
        select(ShardRow.kind, JobRow.stage_total, func.max(ShardRow.index) + 1)
        .join(JobRow, (JobRow.id == ShardRow.job_id) & (JobRow.stage == ShardRow.stage))
        .where(JobRow.stage_total > STAGE_WINDOW, JobRow.state.not_in(TERMINAL_STATES))
        .group_by(JobRow.id, ShardRow.kind, JobRow.stage_total)
    )
    for kind, total, here in session.execute(made):
        if here < total:
            counts[kind, QUEUED] = counts.get((kind, QUEUED), 0) + total - here
    return counts
