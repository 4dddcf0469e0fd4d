"""The event log: every change of a job, appended in the same transaction as the change.

Writers of one job hold its lock (``physworld_storage.jobs.shards.lock_job``), so within a job ``seq`` grows in the
order in which the changes became visible, and a reader that remembers the last ``seq`` misses nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from sqlalchemy import and_, or_, select
from sqlalchemy.orm import Session

from physworld_schemas.job import Event
from physworld_storage.tables import EventRow, utc_now

EventType = Literal["state", "progress", "log"]
JOBS_AT_ONCE = 100


def append_event(session: Session, job_id: str, type: EventType, data: dict[str, Any]) -> None:
    """Append one event to the job's log.

    ``state`` carries {"state", "error"?}, ``progress`` a Progress, ``log`` {"message", …}.

    Args:
        session: the transaction in which it happens.
        job_id: whose log it is.
        type: ``state``, ``progress`` or ``log``.
        data: as its type has it, JSON.
    """
    session.add(EventRow(job_id=job_id, type=type, at=utc_now(), data=data))


def events_after(
    session: Session, job_id: str, seq: int, limit: int = 500, *, whole_after: int = 0
) -> list[Event]:
    """Events of the job with a larger ``seq``, oldest first; ``seq=0`` begins at the beginning.

    Up to ``whole_after`` progress events, of which each makes those before it worthless, are left out.

    Args:
        session: the transaction that reads.
        job_id: whose log it is.
        seq: number of the last event that is known.
        limit: most events of an answer.
        whole_after: number up to which progress events are left out; 0 leaves none out.
    """
    statement = select(EventRow).where(EventRow.job_id == job_id, EventRow.seq > seq)
    if whole_after > seq:
        statement = statement.where(or_(EventRow.seq > whole_after, EventRow.type != "progress"))
    return [_event(row) for row in session.scalars(statement.order_by(EventRow.seq).limit(limit))]


def figures_of(session: Session, job_id: str) -> list[tuple[float, dict[str, float]]]:
    """What the job told of its work: (done, figures) of each progress that carried any, oldest first."""
    of = (EventRow.job_id == job_id, EventRow.type == "progress")
    rows = session.scalars(select(EventRow.data).where(*of).order_by(EventRow.seq))
    return [(float(data["done"]), data["figures"]) for data in rows if data.get("figures")]


def newest(session: Session, job_id: str, before: int = 0) -> int:
    """The ``seq`` of the job's newest event, or of the one that ``before`` newer ones follow; 0 where there is none."""
    statement = select(EventRow.seq).where(EventRow.job_id == job_id)
    return session.scalar(statement.order_by(EventRow.seq.desc()).offset(before).limit(1)) or 0


def newer(session: Session, after: Mapping[str, int], limit: int) -> tuple[dict[str, list[Event]], set[str]]:
    """Events of several jobs, each after its own ``seq``, oldest first; and the jobs of which there may be more.

    At most ``limit`` are read of every ``JOBS_AT_ONCE`` jobs.
    """
    found: dict[str, list[Event]] = {}
    more: set[str] = set()
    for begin in range(0, len(after), JOBS_AT_ONCE):
        some = list(after.items())[begin : begin + JOBS_AT_ONCE]
        places = [and_(EventRow.job_id == job_id, EventRow.seq > seq) for job_id, seq in some]
        rows = list(session.scalars(select(EventRow).where(or_(*places)).order_by(EventRow.seq).limit(limit)))
        for row in rows:
            found.setdefault(row.job_id, []).append(_event(row))
        if len(rows) == limit:
            more |= {job_id for job_id, _ in some}
    return found, more


def _event(row: EventRow) -> Event:
    return Event(seq=row.seq, job_id=row.job_id, type=row.type, at=row.at, data=row.data)
