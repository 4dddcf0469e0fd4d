"""Hosts whose clocks are wrong: leases go by the database's clock, on SQLite and, if a server is named, on Postgres."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from uuid import uuid4

import pytest
from pydantic import SecretStr
from sqlalchemy import create_engine, make_url, text
from tiny_scene import register, tiny_scene

from physworld_schemas.fit import FitConfig
from physworld_storage.artifacts import ArtifactStore
from physworld_storage.clock import database_now
from physworld_storage.database import Database, open_database
from physworld_storage.jobs import jobs, leases
from physworld_storage.settings import Settings
from physworld_storage.tables import ShardRow

pytestmark = pytest.mark.slow

POSTGRES_VARIABLE = "PHYSWORLD_TEST_POSTGRES_URL"
HOST = Path(__file__).with_name("wrong_clock.py")
WITHIN_S = 30.0
LEASE_S = 300.0
WRONG_BY_S = [60, -60, 3600, -3600]


@pytest.fixture(params=["sqlite", "postgres"])
def settings(request: pytest.FixtureRequest, tmp_path: Path, broker_url: str) -> Iterator[Settings]:
    places = {
        "data_dir": tmp_path / "data",
        "store_url": (tmp_path / "store").as_uri(),
        "broker_url": SecretStr(broker_url),
    }
    if request.param == "sqlite":
        yield Settings(database_url=f"sqlite:///{tmp_path / 'physworld.db'}", **places)
        return
    server = os.environ.get(POSTGRES_VARIABLE)
    if not server:
        pytest.skip(f"{POSTGRES_VARIABLE} names no Postgres server")
    url = make_url(server).set(drivername="postgresql+psycopg")
    name = f"physworld_clocks_{uuid4().hex[:12]}"
    engine = create_engine(url, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    address = url.set(drivername="postgresql", database=name).render_as_string(hide_password=False)
    yield Settings(database_url=address, **places)
    with engine.connect() as connection:
        connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
    engine.dispose()


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    database = open_database(settings)
    database.upgrade()
    yield database
    database.dispose()


def environment(settings: Settings) -> dict[str, str]:
    assert settings.broker_url is not None
    return {
        **os.environ,
        "PHYSWORLD_DATA_DIR": str(settings.data_dir),
        "PHYSWORLD_DATABASE_URL": settings.database_url,
        "PHYSWORLD_STORE_URL": settings.store_url,
        "PHYSWORLD_BROKER_URL": settings.broker_url.get_secret_value(),
    }


def two_shards(database: Database, settings: Settings) -> list[str]:
    scene_id = register(tiny_scene(), database, ArtifactStore(settings))
    with database.session() as session:
        for _ in range(2):
            jobs.create_fit(session, scene_id, FitConfig())
        return [found.shard_id for found in leases.publishable(session)]


@pytest.mark.parametrize("wrong_by_s", WRONG_BY_S)
def test_a_dispatcher_with_a_wrong_clock_takes_back_what_ran_out_and_nothing_else(
    database: Database, settings: Settings, wrong_by_s: int
) -> None:
    living, dead = two_shards(database, settings)
    with database.session() as session:
        assert leases.claim(session, living, "elsewhere/1/1/1", 30.0) is not None
        assert leases.claim(session, dead, "elsewhere/1/2/1", 30.0) is not None
        session.get_one(ShardRow, dead).lease_until = database_now(session) - timedelta(seconds=1)
    command = [sys.executable, str(HOST), str(wrong_by_s), "dispatch"]
    with subprocess.Popen(command, env=environment(settings), stderr=subprocess.DEVNULL) as dispatcher:
        try:
            deadline = time.monotonic() + WITHIN_S
            while state_of(database, dead) == "RUNNING":
                assert time.monotonic() < deadline
                assert dispatcher.poll() is None
                time.sleep(0.05)
            time.sleep(2.0)  # further sweeps
            assert state_of(database, living) == "RUNNING"
        finally:
            dispatcher.terminate()


@pytest.mark.parametrize("wrong_by_s", WRONG_BY_S)
def test_a_worker_with_a_wrong_clock_gets_a_lease_as_long_as_any(
    database: Database, settings: Settings, wrong_by_s: int
) -> None:
    shard_id, _ = two_shards(database, settings)
    command = [sys.executable, str(HOST), str(wrong_by_s), "claim", shard_id, str(LEASE_S)]
    subprocess.run(command, env=environment(settings), check=True, timeout=WITHIN_S)
    with database.session() as session:
        shard = session.get_one(ShardRow, shard_id)
        assert shard.lease_until is not None
        left_s = (shard.lease_until - database_now(session)).total_seconds()
    assert LEASE_S - WITHIN_S < left_s <= LEASE_S


def state_of(database: Database, shard_id: str) -> str:
    with database.reading() as session:
        return session.get_one(ShardRow, shard_id).state
