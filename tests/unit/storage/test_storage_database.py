"""The database itself: migrations, transactions, what a refusal looks like."""

from __future__ import annotations

import dataclasses
import multiprocessing
import subprocess
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import func, select, text

from physworld_schemas.fit import FitConfig
from physworld_storage import resources
from physworld_storage.database import MIGRATIONS, Database, newest_revision
from physworld_storage.errors import DatabaseUnavailable
from physworld_storage.jobs import jobs
from physworld_storage.patience import WORKING
from physworld_storage.tables import Base, JobRow, SceneRow, utc_now

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from conftest import Work

NEWEST = "0011"
SPAWN = multiprocessing.get_context("spawn")


def upgrade(url: str) -> None:
    database = Database(url)
    database.upgrade()
    database.check()


def test_the_migrations_make_the_tables_of_the_code(database: Database) -> None:
    with database.engine.begin() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, Base.metadata) == []


def test_an_upgrade_twice_is_one(database: Database) -> None:
    revision = database.revision()
    database.upgrade()
    database.check()
    assert database.revision() == revision == NEWEST


def test_an_upgrade_tells_the_cancelled_from_those_that_have_failed(work: Work, database: Database) -> None:
    cancelled, failed = work.fit(), work.fit()
    work.cancel(cancelled)
    work.fail(work.claim(), retry=False)
    with database.session() as session:  # as before the revision 0010
        session.execute(text("UPDATE fits SET state = 'failed'"))
        session.execute(text("DROP INDEX ix_jobs_kind_state_created_at"))
        session.execute(text("ALTER TABLE jobs DROP COLUMN pace"))
        session.execute(text("UPDATE alembic_version SET version_num = '0009'"))
    database.upgrade()
    with database.reading() as session:
        states = [resources.get_fit(session, job.outputs[0].id).state for job in (cancelled, failed)]
    assert states == ["cancelled", "failed"]


def test_the_newest_revision_is_known_without_the_migration_tool(database_url: str) -> None:
    """Alembic takes as long to import as a process takes to start: only a start that has to migrate pays for it."""
    scripts = ScriptDirectory(str(MIGRATIONS))
    assert newest_revision() == scripts.get_current_head()
    code = (
        "import sys; from physworld_storage.database import Database\n"
        "database = Database(sys.argv[1]); database.upgrade(); database.check()\n"
        "assert 'alembic' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code, database_url], check=True)


def test_processes_that_upgrade_at_once_do_not_collide(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'new' / 'physworld.db'}"
    processes = [SPAWN.Process(target=upgrade, args=(url,)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0, 0]


def test_a_database_without_tables_is_not_ready(tmp_path: Path) -> None:
    database = Database(f"sqlite:///{tmp_path / 'empty.db'}")
    assert database.revision() is None
    with pytest.raises(DatabaseUnavailable, match=f"has revision None, this code needs {NEWEST}"):
        database.check()
    database.dispose()


def test_migrations_travel_with_the_package(tmp_path: Path, repository: Path) -> None:
    script = (
        "import sys; sys.path.insert(0, sys.argv[2]);"
        "from physworld_storage.database import Database;"
        "d = Database('sqlite:///' + sys.argv[1]); d.upgrade(); d.check()"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "elsewhere.db"), str(repository)]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)


def test_a_session_commits_all_or_nothing(work: Work, database: Database) -> None:
    scene = work.scene()
    with pytest.raises(ZeroDivisionError):
        with database.session() as session:
            jobs.create_fit(session, scene.id, FitConfig())
            raise ZeroDivisionError
    with database.reading() as session:
        assert session.scalar(select(func.count()).select_from(JobRow)) == 0


def test_a_reader_neither_waits_for_a_writer_nor_sees_half_of_it(work: Work, database: Database) -> None:
    scene = work.scene()
    with database.session() as writer:
        jobs.create_fit(writer, scene.id, FitConfig())
        with database.reading() as reader:
            reader.execute(text("SELECT 1"))
            assert reader.scalar(select(func.count()).select_from(JobRow)) == 0
    with database.reading() as reader:
        assert reader.scalar(select(func.count()).select_from(JobRow)) == 1


def test_writers_queue_up_and_none_is_lost(work: Work, database: Database) -> None:
    """Read, think, write: the pattern that loses updates where a transaction begins as a reader's."""
    scene = work.scene()
    writers, rounds = 6, 10

    def add_one() -> None:
        for _ in range(rounds):
            with database.session() as session:
                statement = select(SceneRow).where(SceneRow.id == scene.id).with_for_update()
                row = session.scalars(statement).one()
                row.frames += 1

    threads = [threading.Thread(target=add_one) for _ in range(writers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with database.reading() as session:
        assert session.get_one(SceneRow, scene.id).frames == 10 + writers * rounds


def test_a_locked_database_is_unavailable_and_says_why(tmp_path: Path, sqlite_template: Path) -> None:
    path = tmp_path / "physworld.db"
    path.write_bytes(sqlite_template.read_bytes())
    first = Database(f"sqlite:///{path}")
    second = Database(f"sqlite:///{path}", patience=dataclasses.replace(WORKING, lock_s=0.05))
    with first.session() as holder:
        holder.execute(text("SELECT 1"))
        with pytest.raises(DatabaseUnavailable, match="database is locked: another writer"):
            with second.session() as session:
                session.execute(text("SELECT 1"))
    first.dispose()
    second.dispose()


def test_a_full_disk_rolls_back(tmp_path: Path, sqlite_template: Path, make_work: type[Work]) -> None:
    """SQLite's own page limit stands for the disk's: the error and the rollback are the same."""
    path = tmp_path / "physworld.db"
    path.write_bytes(sqlite_template.read_bytes())
    database = Database(f"sqlite:///{path}")
    scene = make_work(database).scene()
    with pytest.raises(DatabaseUnavailable, match="database or disk is full"):
        with database.session() as session:
            pages = session.scalar(text("PRAGMA page_count"))
            session.execute(text(f"PRAGMA max_page_count={pages}"))
            for _ in range(1000):
                jobs.create_fit(session, scene.id, FitConfig())
    with database.reading() as session:
        assert session.scalar(select(func.count()).select_from(JobRow)) == 0
    database.dispose()


def test_a_server_that_is_away_is_unavailable() -> None:
    database = Database("postgresql://nobody@127.0.0.1:1/none")
    with pytest.raises(DatabaseUnavailable, match=r"127\.0\.0\.1"):
        with database.session() as session:
            session.execute(text("SELECT 1"))
    database.dispose()


def test_times_are_aware_and_utc(work: Work, database: Database) -> None:
    before = utc_now()
    scene = work.scene()
    with database.reading() as session:
        row = session.get_one(SceneRow, scene.id)
    assert before <= row.created_at <= utc_now()
    assert str(row.created_at.tzinfo) == "UTC"


def test_a_naive_time_is_refused(work: Work, database: Database) -> None:
    scene = work.scene()
    with pytest.raises(Exception, match="naive time"):  # the driver's layer wraps it
        with database.session() as session:
            session.get_one(SceneRow, scene.id).created_at = utc_now().replace(tzinfo=None)
