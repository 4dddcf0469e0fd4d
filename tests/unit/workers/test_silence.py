"""A broker or a database that is silent: whoever works gives up, says so, and goes on once it speaks."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from urllib.parse import urlsplit
from uuid import uuid4

import pytest
import redis
from pydantic import SecretStr
from sqlalchemy import create_engine, make_url, text

import physworld_workers.context
from benchmarks.service.chaos.proxy import FrozenProxy
from physworld_schemas.fit import FitConfig
from physworld_schemas.queues import SIMULATION
from physworld_storage.database import Database
from physworld_storage.jobs import jobs, leases
from physworld_storage.patience import Patience
from physworld_storage.settings import Settings
from physworld_storage.tables import JobRow, ShardRow, utc_now
from physworld_workers.app import create_app
from physworld_workers.context import TaskContext
from physworld_workers.dispatcher import Dispatcher
from physworld_workers.errors import LeaseLost
from physworld_workers.stores import Stores

pytestmark = pytest.mark.slow

WITHIN_S = 25.0
SHORT = Patience(
    connect_s=2,
    ping_s=1.0,
    statement_s=2.0,
    lock_s=2.0,
    pool_s=2.0,
    store_silence_s=2.0,
    store_upload_s=9.0,
    store_retry_s=1.0,
)


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WITHIN_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_broker_that_falls_silent_is_left_and_found_again(
    tmp_path, stores: Stores, scene_id: str, broker_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    address = urlsplit(broker_url)
    with (
        FrozenProxy(str(address.hostname), address.port or 6379) as proxy,
        redis.Redis.from_url(broker_url) as broker,
    ):
        behind = broker_url.replace(f":{address.port}", f":{proxy.port}").replace("localhost", proxy.host)
        settings = Settings(data_dir=tmp_path / "data", broker_url=SecretStr(behind))
        app, stop = create_app(settings), threading.Event()
        dispatcher = Dispatcher(settings, stores.database, app)
        thread = threading.Thread(target=dispatcher.run, args=(stop,), daemon=True)
        thread.start()
        _queue_fit(stores.database, scene_id)
        _until(lambda: broker.llen(SIMULATION) == 1)
        proxy.freeze()
        _queue_fit(stores.database, scene_id)
        _until(lambda: "broker away or full" in caplog.text)
        proxy.thaw()
        _until(lambda: broker.llen(SIMULATION) >= 2)
        proxy.freeze()
        _queue_fit(stores.database, scene_id)
        time.sleep(1.0)
        stop.set()
        thread.join(WITHIN_S)
        assert not thread.is_alive()
        proxy.thaw()
        app.close()


def test_a_worker_whose_renewals_hang_stops_in_time_and_leaves_its_task(
    tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = os.environ.get("PHYSWORLD_TEST_POSTGRES_URL")
    if not server:
        pytest.skip("PHYSWORLD_TEST_POSTGRES_URL names no Postgres server")
    url = make_url(server).set(drivername="postgresql+psycopg")
    name = f"physworld_silent_{uuid4().hex[:12]}"
    engine = create_engine(url, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    with FrozenProxy(str(url.host), url.port or 5432) as proxy:
        behind = url.set(host=proxy.host, port=proxy.port, database=name)
        settings = Settings(data_dir=tmp_path / "data", lease_seconds=4.0)
        database = Database(behind.render_as_string(hide_password=False), patience=SHORT)
        database.upgrade()
        lease = _claimed(database)
        monkeypatch.setattr(physworld_workers.context, "JOIN_S", 1.0)
        with pytest.raises(LeaseLost):
            with TaskContext(lease, database, settings) as context:
                time.sleep(1.0)
                context.check()
                proxy.freeze()
                frozen_at = time.monotonic()
                while True:
                    context.check()
                    time.sleep(0.05)
        assert time.monotonic() - frozen_at < settings.lease_seconds + WITHIN_S
        proxy.thaw()
        _until(lambda: _answers(database))
        with database.session() as session:
            assert leases.renew(session, lease, 4.0) == "held"  # nobody took it meanwhile
        database.dispose()
    with engine.connect() as connection:
        connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
    engine.dispose()


def _answers(database: Database) -> bool:
    try:
        database.check()
    except Exception:  # noqa: BLE001 - any fault is one more moment to wait
        return False
    return True


def _queue_fit(database: Database, scene_id: str) -> None:
    with database.session() as session:
        jobs.create_fit(session, scene_id, FitConfig())


def _claimed(database: Database) -> leases.Lease:
    """The lease of a shard of a job that is nothing but its rows."""
    with database.session() as session:
        rest = {"progress": {}, "inputs": [], "outputs": [], "config": {}}
        session.add(
            JobRow(id="job_1", kind="fit", state="queued", stage_total=1, created_at=utc_now(), **rest)
        )
        session.flush()
        session.add(
            ShardRow(
                id="shd_1",
                job_id="job_1",
                kind="fit",
                stage=0,
                index=0,
                payload={},
                state="QUEUED",
                max_attempts=5,
                created_at=utc_now(),
            )
        )
        session.flush()
        found = leases.claim(session, "shd_1", "test", 30.0)
    assert found is not None
    return found
