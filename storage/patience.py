"""How long a process waits for the database and the store, and what it does once it knows that they are silent.

A stopped server is not a dead one: its kernel acknowledges everything, so no error ever comes by itself, and every wait
needs an end on this side. Who answers requests waits some seconds (``ANSWERING``); who works in the background may wait
longer (``WORKING``). What is timed is silence: a download or a long result that gets on is never cut.

While one end is known to be silent, asking it again would only cost the next caller the same wait, and a thread with
it. ``Silence`` lets one of them ask now and then and tells the others at once.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Patience:
    """Seconds of one kind of process.

    Attributes:
        connect_s: until a connection to Postgres or the store is established and logged in; whole seconds.
        ping_s: until a connection of the pool has answered that it is still good.
        statement_s: a statement in Postgres, by the server's clock; the client gives up ``GRACE_S`` later.
        lock_s: a writer's wait for SQLite's lock.
        pool_s: until another thread gives a connection back.
        store_silence_s: without a byte of an answer of the store.
        store_upload_s: until the store has taken a part of an upload (5 MiB, twelve at a time) and said so.
        store_retry_s: after which a request that failed is not sent to the store again.
    """

    connect_s: int
    ping_s: float
    statement_s: float
    lock_s: float
    pool_s: float
    store_silence_s: float
    store_upload_s: float
    store_retry_s: float


ANSWERING = Patience(
    connect_s=3,
    ping_s=2.0,
    statement_s=6.0,
    lock_s=5.0,
    pool_s=5.0,
    store_silence_s=4.0,
    store_upload_s=30.0,
    store_retry_s=3.0,
)
WORKING = Patience(
    connect_s=5,
    ping_s=5.0,
    statement_s=60.0,
    lock_s=30.0,
    pool_s=30.0,
    store_silence_s=30.0,
    store_upload_s=60.0,
    store_retry_s=30.0,
)
GRACE_S = 1.5
"""A server that answers tells of its own limit before the client stops listening."""
AGAIN_S = 1.0
"""Pause between two askings of an end that is known to be silent."""


class Silence:
    """Whether one end is known to be silent; for all threads of a process. Never waits."""

    def __init__(self, trial_s: float) -> None:
        self._trial_s = trial_s
        self._lock = threading.Lock()
        self._heard_at = time.monotonic()
        self._since: float | None = None
        self._again_at = 0.0

    def silent_s(self) -> float | None:
        """None: ask. Otherwise how long it has been silent; whoever is told so does not ask.

        Of those that come while it is silent one is let through every ``AGAIN_S``, and not while another still waits.
        """
        if self._since is None:
            return None
        with self._lock:
            now = time.monotonic()
            if self._since is None:
                return None
            if now < self._again_at:
                return now - self._since
            self._again_at = now + self._trial_s
            return None

    def heard(self) -> None:
        """It has answered, if only with an error."""
        self._heard_at = time.monotonic()
        if self._since is not None:
            with self._lock:
                self._since = None

    def gave_up(self, asked_at: float) -> None:
        """A wait that began at ``asked_at`` (``time.monotonic``) has ended without an answer.

        Does not count where others were answered meanwhile: then it was that connection.
        """
        with self._lock:
            if self._heard_at > asked_at:
                return
            self._since = self._since or asked_at
            self._again_at = time.monotonic() + AGAIN_S
