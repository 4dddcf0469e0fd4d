"""The one clock that leases go by: the database's.

Whether a lease has run out is decided by comparing times, so all of them have to be of one clock. Hosts' clocks differ;
the database is one. On Postgres the time is the server's. A SQLite database is used by one host only, whose clock the
connection reads. Times that only say when something was made (``created_at``) may come from the host that made it.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime

from sqlalchemy import text
from sqlalchemy.orm import Session

CLOCK = "clock"  # key of Session.info: a clock of the caller's own instead, for tests that move the time
Clock = Callable[[], datetime]

_POSTGRES = text("SELECT clock_timestamp()")
_SQLITE = text("SELECT strftime('%Y-%m-%d %H:%M:%f', 'now')")


def database_now(session: Session) -> datetime:
    """The present time by the database's clock, aware, in UTC; it passes within a transaction too."""
    given: Clock | None = session.info.get(CLOCK)
    if given is not None:
        return given()
    if session.get_bind().dialect.name == "postgresql":
        told: datetime = session.execute(_POSTGRES).scalar_one()
        return told.astimezone(UTC)
    return datetime.fromisoformat(session.execute(_SQLITE).scalar_one()).replace(tzinfo=UTC)
