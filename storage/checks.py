"""Checks of scenes: rows in, wire models out; born pending, filled in by the commit of their shard."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.base import Lineage, Page
from physworld_schemas.check import Check, CheckReport
from physworld_storage.pages import page_of
from physworld_storage.rows import chosen, pending, required
from physworld_storage.tables import CheckRow, columns_of


def get_check(session: Session, check_id: str) -> Check:
    """The check, or NotFound."""
    return _check(required(session, CheckRow, check_id))


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
    statement = chosen(select(CheckRow), (CheckRow.state, state), (CheckRow.scene_id, scene_id))
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
    row = pending(session, CheckRow, check_id)
    row.state = "ready"
    row.report = report.model_dump(mode="json")
    row.lineage = lineage.model_dump(mode="json")
    session.flush()


def _check(row: CheckRow) -> Check:
    return Check.model_validate(columns_of(row))
