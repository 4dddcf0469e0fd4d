"""Tickets: a text that opens one connection, once, within a minute.

A browser can put no header on a WebSocket, and a key in an address would end up in logs. So the holder of a key asks
for a ticket over HTTP and presents it; it is kept as its SHA-256, bound to what it was asked for, and gone when used.
"""

from __future__ import annotations

import hashlib
import secrets
from datetime import datetime, timedelta

from sqlalchemy import CursorResult, delete, select
from sqlalchemy.orm import Session

from storage.api_keys import ApiKey, get_active_key
from storage.tables import TicketRow, utc_now

LIFETIME = timedelta(seconds=60)
TICKET_BYTES = 32


def issue(session: Session, key_id: str, subject: str) -> tuple[str, datetime]:
    """A ticket for ``subject`` in the name of a key, and when it ends. Tickets that are over are removed."""
    now = utc_now()
    session.execute(delete(TicketRow).where(TicketRow.expires_at < now))
    ticket, until = secrets.token_urlsafe(TICKET_BYTES), now + LIFETIME
    session.add(TicketRow(digest=_digest(ticket), key_id=key_id, subject=subject, expires_at=until))
    session.flush()
    return ticket, until


def redeem(session: Session, ticket: str, subject: str) -> ApiKey | None:
    """The key behind a ticket for ``subject``, which is then used up; None when it is unknown or over."""
    row = session.scalars(select(TicketRow).where(TicketRow.digest == _digest(ticket))).one_or_none()
    if row is None or row.subject != subject:
        return None
    gone = session.execute(delete(TicketRow).where(TicketRow.digest == row.digest))
    assert isinstance(gone, CursorResult)
    if gone.rowcount != 1 or row.expires_at < utc_now():  # somebody was faster, or it is over
        return None
    return get_active_key(session, row.key_id)


def _digest(ticket: str) -> str:
    return hashlib.sha256(ticket.encode()).hexdigest()
