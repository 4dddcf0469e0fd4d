"""The event log: every change of a job, appended in the same transaction as the change.

Writers of one job hold its lock (``storage.locks.lock_job``), so within a job ``seq`` grows in the order in
which the changes became visible, and a reader that remembers the last ``seq`` misses nothing.
"""

from __future__ import annotations

from typing import Any, Literal

from sqlalchemy import select
from sqlalchemy.orm import Session

from schemas.job import Event
from storage.tables import EventRow, utc_now

EventType = Literal["state", "progress", "log"]


def append_event(session: Session, job_id: str, type: EventType, data: dict[str, Any]) -> None:
    """Append one event to the job's log.

    ``state`` carries {"state", "error"?}, ``progress`` a Progress, ``log`` {"message", …}.
    """
    session.add(EventRow(job_id=job_id, type=type, at=utc_now(), data=data))


def events_after(session: Session, job_id: str, seq: int, limit: int = 500) -> list[Event]:
    """Events of the job with a larger ``seq``, oldest first; ``seq=0`` begins at the beginning."""
    rows = session.scalars(
        select(EventRow)
        .where(EventRow.job_id == job_id, EventRow.seq > seq)
        .order_by(EventRow.seq)
        .limit(limit)
    )
    return [Event(seq=row.seq, job_id=row.job_id, type=row.type, at=row.at, data=row.data) for row in rows]
