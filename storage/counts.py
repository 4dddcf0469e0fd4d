"""How many jobs and shards are in which state: the figures of the metrics page, two statements."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from storage.tables import JobRow, ShardRow


def count_jobs(session: Session) -> dict[tuple[str, str], int]:
    """Jobs by (kind, state)."""
    rows = session.execute(
        select(JobRow.kind, JobRow.state, func.count()).group_by(JobRow.kind, JobRow.state)
    )
    return {(kind, state): count for kind, state, count in rows}


def count_shards(session: Session) -> dict[tuple[str, str], int]:
    """Shards by (kind, state)."""
    rows = session.execute(
        select(ShardRow.kind, ShardRow.state, func.count()).group_by(ShardRow.kind, ShardRow.state)
    )
    return {(kind, state): count for kind, state, count in rows}
