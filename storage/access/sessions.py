"""Sessions of browsers, kept by the service: a log-out ends one at once, wherever its cookie was copied to.

A session is a random text of 256 bits that only the browser has; here lies its SHA-256, with the key that opened it.
It ends at log-out, ``IDLE`` after its last request, ``LIFETIME`` after its beginning, or with its key. Several web
processes share them, and a restart ends none.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from sqlalchemy import CursorResult, Delete, Select, delete, or_, select, update
from sqlalchemy.orm import Session

from physworld_storage.access import audit
from physworld_storage.access.api_keys import ApiKey, digest_of, is_active, key_of_row
from physworld_storage.access.audit import Actor
from physworld_storage.tables import ApiKeyRow, RetiredTokenRow, SessionRow, utc_now

IDLE, LIFETIME = timedelta(minutes=30), timedelta(hours=12)
SEEN_EVERY = timedelta(minutes=1)  # how exactly the last request is known: looking at a page is no write
SESSION_BYTES = 32


@dataclass(frozen=True)
class BrowserSession:
    """A session as the holder of its key sees it."""

    credential: str
    address: str | None
    created_at: datetime
    seen_at: datetime


def begin(session: Session, key: ApiKey, by: Actor) -> str:
    """A new session of a key, as the text that only the browser keeps. Sessions that are over are removed.

    One that an older token opens ends with that token. The key is locked, so a rotation comes before or after it.
    """
    now, text = utc_now(), secrets.token_urlsafe(SESSION_BYTES)
    session.execute(select(ApiKeyRow.id).where(ApiKeyRow.id == key.id).with_for_update())
    older = session.get(RetiredTokenRow, key.credential)
    end = now + LIFETIME if older is None else min(now + LIFETIME, older.valid_until)
    session.execute(
        delete(SessionRow).where(or_(SessionRow.expires_at < now, SessionRow.seen_at < now - IDLE))
    )
    times = {"created_at": now, "seen_at": now, "expires_at": end}
    session.add(SessionRow(digest=digest_of(text), key_id=key.id, address=by.address, **times))
    audit.record(session, by, "session.begun", key.id)
    session.flush()
    return text


def viewer(session: Session, text: str) -> tuple[ApiKey, bool] | None:
    """The key behind a session that is good, and whether it is time to ``touch`` the session; else None."""
    now = utc_now()
    (statement,) = standing([digest_of(text)], now)
    found = session.execute(statement.add_columns(SessionRow.seen_at)).one_or_none()
    if found is None:
        return None
    credential, row, seen_at = found
    return key_of_row(row, credential), seen_at < now - SEEN_EVERY


def standing(credentials: Sequence[str], now: datetime) -> tuple[Select[str, ApiKeyRow]]:
    """A query for the good sessions among these credentials, with their keys."""
    good = SessionRow.expires_at > now, SessionRow.seen_at > now - IDLE, is_active(now)
    return (
        select(SessionRow.digest, ApiKeyRow)
        .join(ApiKeyRow, ApiKeyRow.id == SessionRow.key_id)
        .where(SessionRow.digest.in_(credentials), *good),
    )


def list_sessions(session: Session, key_id: str) -> list[BrowserSession]:
    """The good sessions of a key, newest first."""
    now, row = utc_now(), SessionRow
    open_ones = row.key_id == key_id, row.expires_at > now, row.seen_at > now - IDLE
    found = session.scalars(select(row).where(*open_ones).order_by(row.created_at.desc(), row.digest))
    return [BrowserSession(one.digest, one.address, one.created_at, one.seen_at) for one in found]


def touch(session: Session, credential: str) -> None:
    """Note that the session was used now."""
    session.execute(update(SessionRow).where(SessionRow.digest == credential).values(seen_at=utc_now()))


def end(session: Session, credential: str, by: Actor) -> None:
    """End one session; one that is over already is no error."""
    if _delete(session, delete(SessionRow).where(SessionRow.digest == credential)):
        audit.record(session, by, "session.ended", by.key_id)


def end_all(session: Session, key_id: str, by: Actor) -> int:
    """End every session of a key; how many there were."""
    gone = _delete(session, delete(SessionRow).where(SessionRow.key_id == key_id))
    audit.record(session, by, "session.ended", key_id, sessions=gone)
    return gone


def _delete(session: Session, statement: Delete) -> int:
    gone = session.execute(statement)
    assert isinstance(gone, CursorResult)
    return gone.rowcount
