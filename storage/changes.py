"""Waiting for work without asking for it: a wait that ends when somebody commits.

On Postgres whoever queues a shard announces it (``NOTIFY``, delivered when the transaction commits, at once and only
then), and the waiter listens on a connection of its own. On SQLite, which is one host, the waiter asks ``PRAGMA
data_version`` every ``POLL_S`` on a connection that it keeps: the number changes with every commit of another
connection, and reading it takes some microseconds.

A wait is a hint. It may end for nothing, and behind a pooler that does not pass notifications on it never ends early:
whoever waits looks again after a while in any case.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import Any

from sqlalchemy import text
from sqlalchemy.orm import Session

from physworld_storage.database import Database
from physworld_storage.errors import DatabaseUnavailable

POSTGRES = "postgresql"
CHANNEL = "physworld_shards"
POLL_S = 0.05
STOP_S = 0.5
"""How often a wait on Postgres looks whether it is told to stop."""


def announce(session: Session) -> None:
    """Say that shards were queued, once this transaction commits. On SQLite the commit itself says so."""
    if session.get_bind().dialect.name == POSTGRES:
        session.execute(text(f"NOTIFY {CHANNEL}"))


class Changes:
    """Commits of others since the last wait; one thread's. Raises DatabaseUnavailable where the database is away."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._dialect = database.engine.dialect
        self._connection: Any = None
        self._errors: type[Exception] = self._dialect.loaded_dbapi.Error
        self._version = 0

    def wait(self, seconds: float, stop: threading.Event) -> bool:
        """Wait for a change, ``seconds`` at most or until ``stop``; whether one came.

        What was committed since the last wait ended counts; the first wait begins by listening, and what was committed
        before that is the caller's to see: it ends at once.
        """
        try:
            if self._connection is None:
                self._open()
                return True
            deadline = time.monotonic() + seconds
            await_change = self._notified if self._dialect.name == POSTGRES else self._committed
            return await_change(deadline, stop)
        except self._errors as error:
            self.close()
            raise DatabaseUnavailable(str(error).strip() or type(error).__name__) from error

    def close(self) -> None:
        """Give the connection up; the next wait opens another."""
        connection, self._connection = self._connection, None
        if connection is not None:
            with suppress(self._errors):
                connection.close()

    def _open(self) -> None:
        self._connection = self._database.own_connection()
        if self._dialect.name == POSTGRES:
            self._connection.rollback()
            self._connection.autocommit = True
            self._connection.execute(f"LISTEN {CHANNEL}")
        else:
            self._version = self._data_version()

    def _notified(self, deadline: float, stop: threading.Event) -> bool:
        while (left := deadline - time.monotonic()) > 0 and not stop.is_set():
            for _ in self._connection.notifies(timeout=min(STOP_S, left), stop_after=1):
                return True
        return False

    def _committed(self, deadline: float, stop: threading.Event) -> bool:
        while True:
            version = self._data_version()
            if version != self._version:
                self._version = version
                return True
            left = deadline - time.monotonic()
            if left <= 0 or stop.wait(min(POLL_S, left)):
                return False

    def _data_version(self) -> int:
        (version,) = self._connection.execute("PRAGMA data_version").fetchone()
        return int(version)
