"""The database: one engine per process, transactions that either happen or do not.

SQLite (one host, WAL) begins every writing transaction with ``BEGIN IMMEDIATE``: writers queue up at the
start instead of failing in the middle, so a read followed by a write in one transaction is a law, not a race.
Postgres locks rows instead (``physworld_storage.jobs.shards.lock_job``). A killed process loses no committed
transaction; with SQLite's ``synchronous=NORMAL`` a power cut may lose the last moments but never the consistency.
"""

from __future__ import annotations

import functools
import json
import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sqlalchemy import (
    Connection,
    Engine,
    column,
    create_engine,
    event,
    inspect,
    make_url,
    select,
    table,
)
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import Session

from physworld_storage.clock import CLOCK, Clock
from physworld_storage.errors import DatabaseUnavailable
from physworld_storage.patience import GRACE_S, WORKING, Patience, Silence
from physworld_storage.settings import Settings

FEW_THREADS = 8
KEPT_CONNECTIONS = 10
"""Connections that stay open when nobody uses them; more are made while more threads want one."""
SHORT_LOCK_S = 0.25
"""A writer's wait for SQLite's lock while another one has just waited in vain."""
NEVER = 10 * 365 * 86400.0
DEFAULT_MAX_ATTEMPTS = 5
MAX_ATTEMPTS = "max_attempts"  # key of Session.info: the cap that new shards are given
MIGRATIONS = Path(__file__).parent / "migrations"
REVISION_TABLE = "alembic_version"

_dumps = functools.partial(json.dumps, allow_nan=False)


class Database:
    """An engine and its transactions. Safe over ``fork``: a child never uses its parent's connections.

    Args:
        threads: of the process that use it at the same time; as many connections are made at most.
        patience: how long anything of it is waited for. Migrations are waited for without an end.
        clock: what leases go by instead of the database's clock, for tests that move the time.
    """

    def __init__(
        self,
        url: str,
        *,
        max_attempts: int = DEFAULT_MAX_ATTEMPTS,
        threads: int = FEW_THREADS,
        patience: Patience = WORKING,
        clock: Clock | None = None,
    ) -> None:
        self._silence = Silence(patience.ping_s + patience.connect_s)
        self._patience = patience
        self.engine = _create_engine(url, threads, patience, self._silence)
        self._reading_engine = self.engine.execution_options(sqlite_begin="BEGIN")
        self._max_attempts = max_attempts
        self._clock = clock
        self._process = os.getpid()

    @contextmanager
    def session(self) -> Iterator[Session]:
        """A writing transaction: committed at the end of the block, rolled back by an exception in it."""
        with self._transaction(self.engine) as session:
            yield session

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A snapshot for reading; on SQLite it neither waits for writers nor holds them up."""
        with self._transaction(self._reading_engine) as session:
            yield session

    def upgrade(self) -> None:
        """Bring the tables to the newest revision; harmless when several processes do it at once."""
        if self.revision() == newest_revision():
            return
        from alembic import command  # takes as long to import as a process without migrations to start
        from alembic.config import Config

        config = Config()
        config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
        config.set_main_option("path_separator", "os")
        with self._translated(), self.engine.begin() as connection, _without_limits(connection):
            config.attributes["connection"] = connection
            command.upgrade(config, "head")

    def revision(self) -> str | None:
        """The revision that the tables have, None before the first ``upgrade``."""
        self._leave_parent()
        self._ask()
        with self._translated(), self._reading_engine.connect() as connection:
            if not inspect(connection).has_table(REVISION_TABLE):
                return None
            return connection.scalar(select(column("version_num")).select_from(table(REVISION_TABLE)))

    def check(self) -> None:
        """Raise DatabaseUnavailable unless the database answers and has this code's tables."""
        found, wanted = self.revision(), newest_revision()
        if found != wanted:
            told = f"the database has revision {found}, this code needs {wanted}"
            raise DatabaseUnavailable(told, told)

    def own_connection(self) -> Any:
        """A connection of the driver's, outside of the pool: the caller keeps it and closes it."""
        self._leave_parent()
        with self._translated():
            pooled = self.engine.raw_connection()
            pooled.detach()
            return pooled.dbapi_connection

    def dispose(self) -> None:
        """Close every connection of this process."""
        self.engine.dispose()

    @contextmanager
    def _transaction(self, engine: Engine) -> Iterator[Session]:
        self._leave_parent()
        self._ask()
        with self._translated(), Session(engine, expire_on_commit=False) as session, session.begin():
            session.info[MAX_ATTEMPTS] = self._max_attempts
            session.info[CLOCK] = self._clock
            yield session

    def _ask(self) -> None:
        """Raise DatabaseUnavailable at once while the server is known to be silent."""
        silent_s = self._silence.silent_s()
        if silent_s is not None:
            told = f"the database has not answered for {silent_s:.1f} s"
            raise DatabaseUnavailable(told, told)

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """What the database itself refuses (locked, full, gone, silent) becomes DatabaseUnavailable."""
        try:
            yield
        except PoolTimeout as error:
            told = f"no connection to the database came free within {self._patience.pool_s:g} s"
            raise DatabaseUnavailable(told, told) from error
        except (OperationalError, InterfaceError) as error:
            raise DatabaseUnavailable(*_reasons(error)) from error

    def _leave_parent(self) -> None:
        if os.getpid() != self._process:
            self.engine.dispose(close=False)
            self._process = os.getpid()


def open_database(
    settings: Settings, *, threads: int = FEW_THREADS, patience: Patience = WORKING
) -> Database:
    """The database that the settings name; its tables are made by ``upgrade``."""
    return Database(
        settings.database_url, max_attempts=settings.max_attempts, threads=threads, patience=patience
    )


def _create_engine(address: str, threads: int, patience: Patience, silence: Silence) -> Engine:
    url = make_url(address)
    kept = min(threads, KEPT_CONNECTIONS)
    options: dict[str, Any] = {"json_serializer": _dumps}
    pool = {"pool_size": kept, "max_overflow": threads - kept, "pool_timeout": patience.pool_s}
    if url.get_backend_name() == "sqlite":
        if url.database and url.database != ":memory:" and not url.database.startswith("file:"):
            _make_private(Path(url.database))
        if url.database and url.database != ":memory:":  # one in memory has one connection
            options.update(pool)
        engine = create_engine(url, connect_args={"timeout": patience.lock_s}, **options)
        event.listen(engine, "connect", functools.partial(_prepare_sqlite, patience))
        event.listen(engine, "begin", _Lock(patience))
        return engine
    from physworld_storage import postgres  # the driver, which SQLite does not need

    if url.drivername in {"postgresql", "postgres"}:
        url = url.set(drivername="postgresql+psycopg")
    engine = create_engine(url, pool_pre_ping=True, **pool, **options)

    @event.listens_for(engine, "do_connect")
    def connect(_dialect: Any, _record: Any, arguments: Any, given: dict[str, Any]) -> Any:
        return postgres.connect(patience, silence, arguments, given)

    @event.listens_for(engine, "checkin")
    def returned(connection: Any, _record: Any) -> None:
        if connection is not None:
            connection.silence_s = patience.ping_s  # the next thing asked of it is whether it is still good

    @event.listens_for(engine, "checkout")
    def taken(connection: Any, _record: Any, _proxy: Any) -> None:
        connection.silence_s = patience.statement_s + GRACE_S

    return engine


def _make_private(path: Path) -> None:
    """Make the file and its folder for their owner only, and close files of before, which were readable by all.

    SQLite gives the files beside it (``-wal``, ``-shm``) the mode of the database.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with suppress(FileExistsError):
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
    for name in (path.name, f"{path.name}-wal", f"{path.name}-shm"):
        with suppress(FileNotFoundError, PermissionError):  # gone meanwhile, or another owner's
            file = path.with_name(name)
            if file.stat().st_mode & 0o077:
                file.chmod(0o600)


def _prepare_sqlite(patience: Patience, connection: sqlite3.Connection, _record: Any) -> None:
    connection.isolation_level = None  # transactions are begun by _Lock, not guessed by the driver
    deadline = time.monotonic() + patience.lock_s
    for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "foreign_keys=ON"):
        while True:
            try:
                connection.execute(f"PRAGMA {pragma}").close()
                break
            except (
                sqlite3.OperationalError
            ):  # turning WAL on does not wait for the lock of another first opener
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.02)


class _Lock:
    """Begins transactions in SQLite. While its lock is known not to come free, writers wait ``SHORT_LOCK_S`` only.

    Otherwise those that had to wait for a thread of the process would begin to wait when the first ones gave up.
    """

    def __init__(self, patience: Patience) -> None:
        self._patience_s = patience.lock_s
        self._in_vain = False

    def __call__(self, connection: Connection) -> None:
        begin = connection.get_execution_options().get("sqlite_begin", "BEGIN IMMEDIATE")
        if begin != "BEGIN IMMEDIATE":
            connection.exec_driver_sql(begin)
            return
        wait_s = SHORT_LOCK_S if self._in_vain else self._patience_s
        connection.exec_driver_sql(f"PRAGMA busy_timeout = {round(1000 * wait_s)}").close()
        try:
            connection.exec_driver_sql(begin)
        except OperationalError as error:
            self._in_vain = self._in_vain or "locked" in str(error.orig)
            raise
        self._in_vain = False


@contextmanager
def _without_limits(connection: Connection) -> Iterator[None]:
    """Statements of this transaction may take as long as they take: rewriting a large table has no usual length."""
    if connection.dialect.name != "postgresql":
        yield
        return
    connection.exec_driver_sql("SET LOCAL statement_timeout = 0")
    driver: Any = connection.connection.dbapi_connection
    limit_s, driver.silence_s = driver.silence_s, NEVER
    try:
        yield
    finally:
        driver.silence_s = limit_s


@functools.cache
def newest_revision() -> str:
    """The revision that this code needs: migrations are called NNNN_title.py by their revision."""
    scripts = (MIGRATIONS / "versions").glob("[0-9]*_*.py")
    return max(script.name.partition("_")[0] for script in scripts)


def _reasons(error: DBAPIError) -> tuple[str, str]:
    """What the driver says, which may name hosts and is for the log; and what anybody may be told."""
    reason = str(error.orig).strip() or type(error.orig).__name__
    if "locked" in reason:
        told = "another writer held the database for too long"
        return f"{reason}: {told}", told
    if "silent" in reason or "timeout" in reason:
        return reason, "the database did not answer in time"
    return reason, "the database cannot be reached or refuses to work"
