"""The database: one engine per process, transactions that either happen or do not.

SQLite (one host, WAL) begins every writing transaction with ``BEGIN IMMEDIATE``: writers queue up at the
start instead of failing in the middle, so a read followed by a write in one transaction is a law, not a race.
Postgres locks rows instead (``storage.locks.lock_job``). A killed process loses no committed transaction; with
SQLite's ``synchronous=NORMAL`` a power cut may lose the last moments but never the consistency.
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

from sqlalchemy import Connection, Engine, create_engine, event, inspect, make_url, text
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError
from sqlalchemy.orm import Session

from storage.errors import DatabaseUnavailable
from storage.settings import Settings

BUSY_SECONDS = 30.0
DEFAULT_MAX_ATTEMPTS = 5
MAX_ATTEMPTS = "max_attempts"  # key of Session.info: the cap that new shards are given
MIGRATIONS = Path(__file__).parent / "migrations"
REVISION_TABLE = "alembic_version"

_dumps = functools.partial(json.dumps, allow_nan=False)


class Database:
    """An engine and its transactions. Safe over ``fork``: a child never uses its parent's connections."""

    def __init__(self, url: str, *, max_attempts: int = DEFAULT_MAX_ATTEMPTS) -> None:
        self.engine = _create_engine(url)
        self._reading_engine = self.engine.execution_options(sqlite_begin="BEGIN")
        self._max_attempts = max_attempts
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
        with _translated(), self.engine.begin() as connection:
            config.attributes["connection"] = connection
            command.upgrade(config, "head")

    def revision(self) -> str | None:
        """The revision that the tables have, None before the first ``upgrade``."""
        self._leave_parent()
        with _translated(), self._reading_engine.connect() as connection:
            if not inspect(connection).has_table(REVISION_TABLE):
                return None
            return connection.scalar(text(f"SELECT version_num FROM {REVISION_TABLE}"))

    def check(self) -> None:
        """Raise DatabaseUnavailable unless the database answers and has this code's tables."""
        found, wanted = self.revision(), newest_revision()
        if found != wanted:
            raise DatabaseUnavailable(f"the database has revision {found}, this code needs {wanted}")

    def own_connection(self) -> Any:
        """A connection of the driver's, outside of the pool: the caller keeps it and closes it."""
        self._leave_parent()
        with _translated():
            pooled = self.engine.raw_connection()
            pooled.detach()
            return pooled.dbapi_connection

    def dispose(self) -> None:
        """Close every connection of this process."""
        self.engine.dispose()

    @contextmanager
    def _transaction(self, engine: Engine) -> Iterator[Session]:
        self._leave_parent()
        with _translated(), Session(engine, expire_on_commit=False) as session, session.begin():
            session.info[MAX_ATTEMPTS] = self._max_attempts
            yield session

    def _leave_parent(self) -> None:
        if os.getpid() != self._process:
            self.engine.dispose(close=False)
            self._process = os.getpid()


def open_database(settings: Settings) -> Database:
    """The database that the settings name; its tables are made by ``upgrade``."""
    return Database(settings.database_url, max_attempts=settings.max_attempts)


def _create_engine(address: str) -> Engine:
    url = make_url(address)
    if url.get_backend_name() == "sqlite":
        if url.database and url.database != ":memory:" and not url.database.startswith("file:"):
            _make_private(Path(url.database))
        engine = create_engine(url, connect_args={"timeout": BUSY_SECONDS}, json_serializer=_dumps)
        event.listen(engine, "connect", _prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
        return engine
    if url.drivername in {"postgresql", "postgres"}:
        url = url.set(drivername="postgresql+psycopg")
    return create_engine(url, pool_pre_ping=True, json_serializer=_dumps)


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


def _prepare_sqlite(connection: sqlite3.Connection, _record: Any) -> None:
    connection.isolation_level = None  # transactions are begun by _begin_sqlite, not guessed by the driver
    deadline = time.monotonic() + BUSY_SECONDS
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


def _begin_sqlite(connection: Connection) -> None:
    connection.exec_driver_sql(connection.get_execution_options().get("sqlite_begin", "BEGIN IMMEDIATE"))


@functools.cache
def newest_revision() -> str:
    """The revision that this code needs: migrations are called NNNN_title.py by their revision."""
    scripts = (MIGRATIONS / "versions").glob("[0-9]*_*.py")
    return max(script.name.partition("_")[0] for script in scripts)


@contextmanager
def _translated() -> Iterator[None]:
    """What the database itself refuses (locked, full, gone) becomes DatabaseUnavailable."""
    try:
        yield
    except (OperationalError, InterfaceError) as error:
        raise DatabaseUnavailable(_reason(error)) from error


def _reason(error: DBAPIError) -> str:
    reason = str(error.orig).strip() or type(error.orig).__name__
    if "locked" in reason:
        return f"{reason}: another writer held the database for more than {BUSY_SECONDS:.0f} s"
    return reason


def ping(session: Session) -> None:
    """One round trip to the database."""
    session.execute(text("SELECT 1"))
