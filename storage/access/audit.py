"""Who changed what, written in the transaction of the change; entries are added and read, never changed.

Keys made, rotated, revoked and recovered, logins and log-outs, addresses that tried too often, jobs cancelled
or retried, aliases moved. No entry holds a token, a ticket or a session.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from physworld_schemas.audit import AuditEntry
from physworld_schemas.base import Page
from physworld_storage.pages import page_of
from physworld_storage.tables import AuditRow, columns_of, utc_now


@dataclass(frozen=True)
class Actor:
    """Who does something: the id of an API key, and the address that it came from."""

    key_id: str | None = None
    address: str | None = None


LOCAL = Actor()
"""A process that has the database itself: a command, the supervisor, the migration."""


def record(session: Session, by: Actor, action: str, subject: str | None, **detail: Any) -> None:
    """Add one entry to the audit log.

    Args:
        session: the transaction that does what is recorded.
        by: who does it.
        action: as ``noun.participle``, such as ``key.created``.
        subject: an id or a name that it is done to.
        **detail: what else the entry holds, as JSON.
    """
    values = {"actor": by.key_id, "address": by.address, "action": action, "subject": subject}
    session.add(AuditRow(at=utc_now(), detail=detail, **values))


def list_entries(session: Session, *, limit: int = 50, cursor: str | None = None) -> Page[AuditEntry]:
    """Entries, newest first."""

    def entry(row: AuditRow) -> AuditEntry:
        return AuditEntry.model_validate(columns_of(row))

    return page_of(session, select(AuditRow), (AuditRow.seq,), entry, limit=limit, cursor=cursor)
