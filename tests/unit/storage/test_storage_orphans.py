"""Artifacts without a row go, and none goes that a row names or somebody is about to name. In a folder and a bucket."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta

import pytest
from sqlalchemy import insert, select, update
from sqlalchemy.orm import Session

from physworld_schemas.fit import FitConfig
from physworld_storage import orphans
from physworld_storage.artifacts import ArtifactStore
from physworld_storage.database import Database
from physworld_storage.jobs import jobs, leases
from physworld_storage.orphans import FEW, NAMING, remove_orphan_artifacts
from physworld_storage.settings import Settings
from physworld_storage.tables import Base, FitRow, ShardRow, utc_now

DAY = timedelta(days=1)


class Clock:
    """The database's time, which a test moves; that of the store goes on."""

    def __init__(self) -> None:
        self.ahead = timedelta()

    def __call__(self) -> datetime:
        return utc_now() + self.ahead


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def database(database_url: str, clock: Clock) -> Iterator[Database]:
    opened = Database(database_url, clock=clock)
    yield opened
    opened.dispose()


@pytest.fixture
def artifacts(store_settings: Settings) -> ArtifactStore:
    return ArtifactStore(store_settings)


@pytest.fixture
def sweep(store_settings: Settings, database: Database) -> Callable[[], list[str]]:
    return lambda: remove_orphan_artifacts(store_settings, database)


def test_what_no_row_names_goes_after_a_day_and_what_a_row_names_stays(
    artifacts: ArtifactStore, database: Database, clock: Clock, make_work, sweep
) -> None:
    work = make_work(database)
    orphan, named = artifacts.put_bytes(b"lost", "twin.npz"), artifacts.put_bytes(b"kept", "twin.npz")
    fit = work.fit()
    work.complete(work.claim(), artifacts=[named.model_dump(mode="json")])
    assert work.job(fit).state == "succeeded"
    clock.ahead = DAY - timedelta(minutes=5)
    assert sweep() == []
    clock.ahead = DAY + timedelta(minutes=5)
    assert sweep() == [orphan.sha256]
    assert not artifacts.exists(orphan.sha256)
    assert artifacts.read_bytes(named.sha256) == b"kept"
    assert sweep() == []


def test_nothing_goes_that_was_written_since_a_running_attempt_began(
    artifacts: ArtifactStore, database: Database, clock: Clock, make_work, sweep
) -> None:
    """However long the attempt takes: it commits what it wrote first only at its end."""
    work = make_work(database)
    work.fit()
    lease = work.claim()
    early = artifacts.put_bytes(b"early", "twin.npz")
    clock.ahead = 30 * DAY
    assert sweep() == []
    assert work.complete(lease, artifacts=[early.model_dump(mode="json")])
    assert sweep() == []
    assert artifacts.read_bytes(early.sha256) == b"early"


def test_an_attempt_that_lost_its_lease_holds_nothing_back(
    artifacts: ArtifactStore, database: Database, clock: Clock, make_work, sweep
) -> None:
    work = make_work(database)
    work.fit()
    lease = work.claim()
    lost = artifacts.put_bytes(b"lost", "twin.npz")
    clock.ahead = 2 * DAY
    with database.session() as session:
        assert leases.reap(session) == [lease.shard_id]
    assert sweep() == [lost.sha256]
    assert not work.complete(lease, artifacts=[lost.model_dump(mode="json")])


def test_nothing_goes_while_the_beginning_of_an_attempt_is_unknown(
    artifacts: ArtifactStore, database: Database, clock: Clock, make_work, sweep
) -> None:
    work = make_work(database)
    work.fit()
    work.claim()
    artifacts.put_bytes(b"lost", "twin.npz")
    clock.ahead = 30 * DAY
    with database.session() as session:
        leases.recover(session)
    assert sweep() == []


def test_an_old_file_that_an_attempt_puts_again_stays(
    store_settings: Settings, artifacts: ArtifactStore, database: Database, make_work,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Also where it was seen as old and unnamed a moment before: it is looked at again."""
    work = make_work(database)
    work.fit()
    artifacts.put_bytes(b"the same bytes", "twin.npz")
    time.sleep(1.2)  # S3 tells whole seconds
    between = utc_now()
    monkeypatch.setattr(orphans, "_nobody_writes_before", lambda session, age: between)
    before = orphans._named

    def put_meanwhile(session):
        put_meanwhile.lease = work.claim()
        time.sleep(1.2)
        put_meanwhile.artifact = artifacts.put_bytes(b"the same bytes", "twin.npz")
        yield from before(session)

    monkeypatch.setattr(orphans, "_named", put_meanwhile)
    assert remove_orphan_artifacts(store_settings, database) == []
    artifact = put_meanwhile.artifact
    assert work.complete(put_meanwhile.lease, artifacts=[artifact.model_dump(mode="json")])
    assert artifacts.read_bytes(artifact.sha256) == b"the same bytes"


def test_a_file_that_is_put_again_is_as_young_as_its_last_write(artifacts: ArtifactStore) -> None:
    artifact = artifacts.put_bytes(b"hello", "greeting.txt")
    time.sleep(1.2)
    between = utc_now()
    assert list(artifacts.last_written_before(between)) == [artifact.sha256]
    time.sleep(1.2)
    artifacts.put_bytes(b"hello", "greeting.txt")
    assert list(artifacts.last_written_before(between)) == []
    assert not artifacts.remove_if_written_before(artifact.sha256, between)
    assert not artifacts.remove_if_written_before("0" * 64, between)


def test_every_column_that_holds_files_is_looked_at() -> None:
    """A new table with artifacts is to be added to ``NAMING``."""
    holding = {
        (table.name, column.name)
        for table in Base.metadata.tables.values()
        for column in table.columns
        if column.name in {"artifacts", "sha256"}
    }
    assert holding <= {(column.class_.__tablename__, column.key) for column in NAMING}


@pytest.mark.parametrize("column", NAMING, ids=lambda column: f"{column.class_.__tablename__}.{column.key}")
def test_a_file_stays_whichever_column_names_it(column, database: Database, make_work) -> None:
    work = make_work(database)
    work.finish(work.pipeline())
    digest = "ab" * 32
    given = {object: [{"name": "twin.npz", "sha256": digest}], str: digest}  # JSON is any object
    with database.session() as session:
        assert digest not in set(orphans._named(session))
        add_row(session, column.class_, **{column.key: given[column.type.python_type]})
        assert digest in set(orphans._named(session))


def add_row(session: Session, row: type[Base], **given: object) -> None:
    """A row that is as empty as its table allows, of the first of each that it has to belong to."""
    plain = {str: "made", int: 99, float: 1.0, object: {}, datetime: utc_now()}
    for column in row.__table__.columns:
        if column.name not in given and not column.nullable:
            owner = next(iter(column.foreign_keys), None)
            found = None if owner is None else session.scalar(select(owner.column).limit(1))
            given[column.name] = plain[column.type.python_type] if found is None else found
    session.execute(insert(row).values(given))


def test_nothing_goes_from_a_store_whose_rows_are_in_another_database(
    tmp_path, database: Database, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    settings = Settings(data_dir=tmp_path)
    artifacts = ArtifactStore(settings)
    files = [artifacts.put_bytes(f"{number}".encode(), "twin.npz").sha256 for number in range(FEW + 1)]
    clock.ahead = 2 * DAY
    assert remove_orphan_artifacts(settings, database) == []
    assert "21 of 21 artifacts have no row in this database" in caplog.text
    assert all(artifacts.exists(sha256) for sha256 in files)


def test_what_the_shard_of_a_job_was_given_or_has_told_stays(
    database: Database, make_work, artifacts: ArtifactStore
) -> None:
    work = make_work(database)
    work.fit()
    request, told = "12" * 32, "34" * 32
    with database.session() as session:
        session.execute(update(ShardRow).values(payload={"request": request}, result={"files": [told]}))
        assert {request, told} <= set(orphans._named(session))


def test_the_unfinished_write_of_a_killed_process_goes(tmp_path, database: Database, clock: Clock) -> None:
    settings = Settings(data_dir=tmp_path)
    sha256 = ArtifactStore(settings).put_bytes(b"whole", "a").sha256
    assert settings.store_folder is not None
    old, young = (settings.store_folder / "artifacts" / sha256[:2] / f"{sha256}#{n}" for n in (1, 2))
    for part in (old, young):
        part.write_bytes(b"half")
    two_days_ago = time.time() - 2 * DAY.total_seconds()
    os.utime(old, (two_days_ago, two_days_ago))
    remove_orphan_artifacts(settings, database)
    assert young.exists() and not old.exists()


def test_a_job_is_still_created_and_finished_after_a_sweep(
    artifacts: ArtifactStore, database: Database, clock: Clock, make_work, sweep
) -> None:
    work = make_work(database)
    scene = work.scene()
    clock.ahead = 2 * DAY
    artifacts.put_bytes(b"lost", "twin.npz")
    sweep()
    with database.session() as session:
        job = jobs.create_fit(session, scene.id, FitConfig())
    again = artifacts.put_bytes(b"lost", "twin.npz")
    work.complete(work.claim(), artifacts=[again.model_dump(mode="json")])
    with database.reading() as session:
        (row,) = session.query(FitRow).all()
        assert row.artifacts[0]["sha256"] == again.sha256
    assert work.job(job).state == "succeeded" and artifacts.exists(again.sha256)
