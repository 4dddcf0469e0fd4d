"""Tickets: a text that opens one connection, once, within a minute.

A browser can put no header on a WebSocket, and a key in an address would end up in logs. So the holder of a key asks
for a ticket over HTTP and presents it; it is kept as its SHA-256, bound to what it was asked for and to the credential
that asked, and gone when used. It stands in addresses, so logs write ``hide_tickets`` of what they are told.
"""

from __future__ import annotations

import logging
import re
import secrets
from datetime import datetime, timedelta

from sqlalchemy import CursorResult, delete, select
from sqlalchemy.orm import Session

from physworld_storage.access.api_keys import ApiKey, digest_of
from physworld_storage.access.credentials import key_of
from physworld_storage.tables import TicketRow, utc_now

LIFETIME = timedelta(seconds=60)
TICKET_BYTES = 32
_IN_ADDRESS = re.compile(r"(?i)(ticket(?:=|%3d))[\w-]+")


def issue(session: Session, credential: str, subject: str) -> tuple[str, datetime]:
    """A ticket for ``subject`` by whoever has this credential, and its end. Tickets that are over are removed."""
    now = utc_now()
    session.execute(delete(TicketRow).where(TicketRow.expires_at < now))
    ticket, until = secrets.token_urlsafe(TICKET_BYTES), now + LIFETIME
    values = {"credential": credential, "subject": subject, "expires_at": until}
    session.add(TicketRow(digest=digest_of(ticket), **values))
    session.flush()
    return ticket, until


def redeem(session: Session, ticket: str, subject: str) -> ApiKey | None:
    """The key behind a ticket for ``subject``, which is then used up; None when it is unknown or over."""
    row = session.scalars(select(TicketRow).where(TicketRow.digest == digest_of(ticket))).one_or_none()
    if row is None or row.subject != subject:
        return None
    gone = session.execute(delete(TicketRow).where(TicketRow.digest == row.digest))
    assert isinstance(gone, CursorResult)
    if gone.rowcount != 1 or row.expires_at < utc_now():  # somebody was faster, or it is over
        return None
    return key_of(session, row.credential)


def hide_tickets(text: str) -> str:
    """The text without the tickets of the addresses in it."""
    return _IN_ADDRESS.sub(r"\1...", text)


class TicketFilter(logging.Filter):
    """Takes tickets out of what a library logs."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Change the record where its message holds a ticket; every record passes."""
        message = record.getMessage()
        hidden = hide_tickets(message)
        if hidden != message:
            record.msg, record.args = hidden, None
        return True
