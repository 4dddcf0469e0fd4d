"""Connections to Postgres whose waits end: the server's ``statement_timeout``, and a deadline on this side.

The server's own limit is of no use once its process is stopped or the network swallows what it sends, and TCP does not
notice a process that is stopped. ``BoundedConnection`` therefore gives up by its own clock when nothing has arrived for
a while, and closes: SQLAlchemy then takes the connection out of its pool, and nothing was committed that the server had
not already acknowledged.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from typing import Any

import psycopg
from psycopg import errors

from physworld_storage.patience import GRACE_S, Patience, Silence

TCP = {"keepalives": 1, "keepalives_idle": 15, "keepalives_interval": 5, "keepalives_count": 3}
"""A host that vanished under an idle connection (one that listens, say) is noticed within half a minute."""
WAIT_INTERVAL_S = 0.1


class Silent(psycopg.OperationalError):
    """The server did not answer in time."""


class BoundedConnection(psycopg.Connection[Any]):
    """A connection that is closed when the server is silent for ``silence_s`` while it is waited for."""

    silence_s: float = float("inf")
    silence: Silence | None = None

    def wait(self, gen: Any, interval: float = WAIT_INTERVAL_S, timeout: float | None = None) -> Any:
        """psycopg's own wait, with an end."""
        try:
            return super().wait(self._bounded(gen), interval=interval, timeout=timeout)
        except Silent:
            self.pgconn.finish()
            raise

    def _bounded(self, gen: Any) -> Generator[Any, Any, Any]:
        asked_at = heard_at = time.monotonic()
        answered = False
        try:
            wanted = next(gen)
            while True:
                ready = yield wanted
                now = time.monotonic()
                if ready:
                    heard_at, answered = now, True
                elif now - heard_at > self.silence_s:
                    if self.silence is not None:
                        self.silence.gave_up(asked_at)
                    raise Silent(f"the server has been silent for {now - heard_at:.1f} s")
                wanted = gen.send(ready)
        except StopIteration as end:
            if answered and self.silence is not None:
                self.silence.heard()
            return end.value


def connect(
    patience: Patience, silence: Silence, arguments: Any, options: dict[str, Any]
) -> BoundedConnection:
    """A connection of this patience, with ``statement_timeout`` set.

    Args:
        patience: how long connecting and a statement may take.
        silence: counts how long the server has not answered.
        arguments: positional ones of psycopg's ``connect``.
        options: its named ones, over those of ``TCP``.

    Raises:
        ConnectionTimeout: the server did not answer within ``patience.connect_s``.
    """
    asked_at = time.monotonic()
    timed = {
        "connect_timeout": patience.connect_s,
        "tcp_user_timeout": round(1000 * (patience.statement_s + GRACE_S)),
        **TCP,
        **options,
    }
    try:
        connection = BoundedConnection.connect(*arguments, **timed, autocommit=True)
    except errors.ConnectionTimeout:
        silence.gave_up(asked_at)
        raise
    silence.heard()
    connection.silence, connection.silence_s = silence, patience.ping_s
    connection.execute(f"SET statement_timeout = {round(1000 * patience.statement_s)}")
    connection.autocommit = False
    connection.silence_s = patience.statement_s + GRACE_S
    return connection
