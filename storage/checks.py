"""Checks of scenes: rows in, wire models out; born pending, filled in by the commit of their shard."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.base import Lineage, Page, Unmade
from physworld_schemas.check import Check, CheckReport
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.pages import page_of
from physworld_storage.tables import CheckRow, columns_of


def get_check(session: Session, check_id: str) -> Check:
    """The check, or NotFound."""
    return _check(check_row(session, check_id))


def list_checks(
    session: Session,
    *,
    limit: int = 50,
    cursor: str | None = None,
    state: str | None = None,
    scene_id: str | None = None,
) -> Page[Check]:
    """Checks, newest first.

    Args:
        session: to read in.
        limit, cursor: of the page.
        state: only these.
        scene_id: only of this scene.
    """
    statement = select(CheckRow)
    for column, wanted in ((CheckRow.state, state), (CheckRow.scene_id, scene_id)):
        if wanted is not None:
            statement = statement.where(column == wanted)
    return page_of(session, statement, (CheckRow.created_at, CheckRow.id), _check, limit=limit, cursor=cursor)


def mark_check_ready(session: Session, check_id: str, report: CheckReport, lineage: Lineage) -> None:
    """Fill in a pending check.

    Args:
        session: the transaction that commits the shard.
        check_id: of a pending check.
        report: what it found.
        lineage: inputs, seeds and versions.

    Raises:
        NotFound: there is no such check.
        Conflict: it is not pending.
    """
    row = check_row(session, check_id)
    if row.state != "pending":
        raise Conflict(f"check {check_id} is {row.state}; only a pending one can become ready")
    row.state = "ready"
    row.report = report.model_dump(mode="json")
    row.lineage = lineage.model_dump(mode="json")
    session.flush()


def end_check(session: Session, check_id: str, state: Unmade) -> None:
    """Mark a pending check failed or cancelled; a ready one stays as it is."""
    row = check_row(session, check_id)
    if row.state == "pending":
        row.state = state


def check_row(session: Session, check_id: str) -> CheckRow:
    """The row, or NotFound."""
    row = session.get(CheckRow, check_id)
    if row is None:
        raise NotFound("check", check_id)
    return row


def _check(row: CheckRow) -> Check:
    return Check.model_validate(columns_of(row))
