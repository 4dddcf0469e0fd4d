"""The lock under which everything of a job changes."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_storage.errors import NotFound
from physworld_storage.tables import JobRow


def lock_job(session: Session, job_id: str) -> JobRow:
    """The job, locked until the transaction ends; its parent is locked first. Raises NotFound."""
    parent_id = session.scalar(select(JobRow.parent_id).where(JobRow.id == job_id))
    if parent_id is not None:
        _lock(session, parent_id)
    return _lock(session, job_id)


def _lock(session: Session, job_id: str) -> JobRow:
    statement = select(JobRow).where(JobRow.id == job_id).with_for_update(key_share=True)
    row = session.scalars(statement.execution_options(populate_existing=True)).one_or_none()
    if row is None:
        raise NotFound("job", job_id)
    return row
