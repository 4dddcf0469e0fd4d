"""A wait for work ends when a shard is queued, and not before; on SQLite and on Postgres."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import text

from physworld_schemas.fit import FitConfig
from physworld_storage.changes import Changes
from physworld_storage.database import Database
from physworld_storage.errors import DatabaseUnavailable
from physworld_storage.jobs import jobs, leases
from physworld_storage.settings import Settings

if TYPE_CHECKING:
    from conftest import Work

LONG_S, SHORT_S = 60.0, 0.3


@pytest.fixture
def changes(database: Database) -> Iterator[Changes]:
    """Already listening."""
    opened = Changes(database)
    assert opened.wait(LONG_S, threading.Event())  # what came before is the caller's to see
    yield opened
    opened.close()


def test_a_wait_without_a_commit_ends_by_itself(changes: Changes) -> None:
    assert not changes.wait(SHORT_S, threading.Event())


def test_a_shard_that_is_queued_ends_the_wait(changes: Changes, work: Work) -> None:
    thread = threading.Timer(0.2, work.fit)
    thread.start()
    began = time.monotonic()
    assert changes.wait(LONG_S, threading.Event())
    assert time.monotonic() - began < LONG_S / 2
    thread.join()


def test_a_shard_that_was_queued_before_the_wait_began_is_not_missed(changes: Changes, work: Work) -> None:
    work.fit()
    assert changes.wait(LONG_S, threading.Event())


def test_a_shard_that_is_given_back_ends_the_wait(changes: Changes, work: Work) -> None:
    work.fit()
    lease = work.claim()
    while changes.wait(SHORT_S, threading.Event()):
        pass
    with work.database.session() as session:
        assert leases.release(session, lease)
    assert changes.wait(LONG_S, threading.Event())


def test_what_is_rolled_back_changes_nothing(changes: Changes, work: Work) -> None:
    scene = work.scene()
    while changes.wait(SHORT_S, threading.Event()):
        pass
    with pytest.raises(KeyboardInterrupt), work.database.session() as session:
        jobs.create_fit(session, scene.id, FitConfig())
        raise KeyboardInterrupt
    assert not changes.wait(SHORT_S, threading.Event())


def test_a_wait_ends_when_it_is_told_to_stop(changes: Changes) -> None:
    stop = threading.Event()
    threading.Timer(0.1, stop.set).start()
    began = time.monotonic()
    assert not changes.wait(LONG_S, stop)
    assert time.monotonic() - began < LONG_S / 2


def test_a_connection_that_the_server_ends_is_said_and_replaced(
    changes: Changes, database: Database, database_url: str
) -> None:
    if database_url.startswith("sqlite"):
        pytest.skip("SQLite has no server")
    listening = changes._connection.info.backend_pid
    with database.session() as session:
        session.execute(text("SELECT pg_terminate_backend(:pid)"), {"pid": listening})
    with pytest.raises(DatabaseUnavailable):
        changes.wait(LONG_S, threading.Event())
    assert changes.wait(LONG_S, threading.Event())  # listening again: the caller has to look
    assert not changes.wait(SHORT_S, threading.Event())


def test_a_wait_takes_no_connection_of_the_pool(database_url: str, tmp_path) -> None:
    database = Database(Settings(data_dir=tmp_path, database_url=database_url).database_url)
    changes = Changes(database)
    changes.wait(LONG_S, threading.Event())
    assert database.engine.pool.checkedout() == 0  # type: ignore[attr-defined]
    changes.close()
    database.dispose()
