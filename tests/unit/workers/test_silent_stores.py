"""A Postgres or a bucket that is silent: the dispatcher goes on with what it can, a worker gives up and tries later."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from uuid import uuid4

import boto3
import pytest
import redis
from moto.server import ThreadedMotoServer
from pydantic import SecretStr
from sqlalchemy import create_engine, make_url, text
from tiny_scene import register, tiny_scene

import physworld_workers.housekeeping
from benchmarks.service.chaos.proxy import FrozenProxy
from physworld_schemas.fit import FitConfig
from physworld_schemas.queues import SIMULATION
from physworld_storage.artifacts import ArtifactStore
from physworld_storage.database import Database
from physworld_storage.jobs import jobs
from physworld_storage.patience import Patience
from physworld_storage.settings import Settings
from physworld_storage.tables import ShardRow
from physworld_workers.app import create_app
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.dispatcher import STOP_WITHIN_S, Dispatcher
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores

pytestmark = pytest.mark.slow

WITHIN_S = 30.0
LEASE_S = 4.0
SHORT = Patience(
    connect_s=2,
    ping_s=1.0,
    statement_s=2.0,
    lock_s=2.0,
    pool_s=2.0,
    store_silence_s=2.0,
    store_upload_s=6.0,
    store_retry_s=1.0,
)
KEYS = {"aws_access_key_id": "test-access", "aws_secret_access_key": "test-secret"}


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WITHIN_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture
def bucket(tmp_path: Path) -> Iterator[tuple[FrozenProxy, dict[str, str]]]:
    """A proxy before an S3 server, and the settings of a bucket behind it."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    name = f"bucket-{uuid4().hex[:12]}"
    client = boto3.client("s3", endpoint_url=f"http://{host}:{port}", region_name="us-east-1", **KEYS)
    client.create_bucket(Bucket=name)
    client.close()
    with FrozenProxy(host, port) as proxy:
        yield (
            proxy,
            {
                "store_url": f"s3://{name}",
                "s3_endpoint": f"http://127.0.0.1:{proxy.port}",
                "s3_access_key_id": KEYS["aws_access_key_id"],
                "s3_secret_access_key": KEYS["aws_secret_access_key"],
            },
        )
        proxy.thaw()
    server.stop()


@pytest.fixture
def far_database(tmp_path: Path) -> Iterator[tuple[FrozenProxy, Database]]:
    """A proxy before a Postgres, and a database behind it."""
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
        database = Database(behind.render_as_string(hide_password=False), patience=SHORT)
        database.upgrade()
        yield proxy, database
        database.dispose()
    with engine.connect() as connection:
        connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
    engine.dispose()


def _queue_fit(database: Database, scene_id: str) -> str:
    with database.session() as session:
        job = jobs.create_fit(session, scene_id, FitConfig())
        return session.query(ShardRow.id).filter(ShardRow.job_id == job.id).scalar()


def test_a_dispatcher_says_that_postgres_is_silent_and_goes_on_once_it_speaks(
    far_database: tuple[FrozenProxy, Database], tmp_path: Path, broker_url: str,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    proxy, database = far_database
    settings = Settings(data_dir=tmp_path / "data", broker_url=SecretStr(broker_url))
    scene_id = register(tiny_scene(), database, ArtifactStore(settings))
    app, stop = create_app(settings), threading.Event()
    dispatcher = Dispatcher(settings, database, app)
    thread = threading.Thread(target=dispatcher.run, args=(stop,), daemon=True)
    with redis.Redis.from_url(broker_url) as broker:
        thread.start()
        _queue_fit(database, scene_id)
        _until(lambda: broker.llen(SIMULATION) == 1)
        proxy.freeze()
        _until(lambda: "database or store away" in caplog.text)
        proxy.thaw()
        _until(lambda: _answers(database))
        _queue_fit(database, scene_id)
        _until(lambda: broker.llen(SIMULATION) >= 2)
        proxy.freeze()
        time.sleep(0.5)
        stop.set()
        thread.join(WITHIN_S)
        assert not thread.is_alive()
        proxy.thaw()
    app.close()


def test_a_dispatcher_publishes_while_the_bucket_is_silent_and_stops_in_time(
    bucket: tuple[FrozenProxy, dict[str, str]], stores: Stores, scene_id: str, tmp_path: Path,
    broker_url: str, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    proxy, where = bucket
    settings = Settings(data_dir=tmp_path / "data", broker_url=SecretStr(broker_url), **where)
    asked, done = threading.Event(), threading.Event()
    tidy = physworld_workers.housekeeping.remove_ended_scratch

    def observed(*given: object) -> list[str]:
        asked.set()
        ended = tidy(*given)
        done.set()
        return ended

    monkeypatch.setattr(physworld_workers.housekeeping, "remove_ended_scratch", observed)
    app, stop = create_app(settings), threading.Event()
    dispatcher = Dispatcher(settings, stores.database, app)
    thread = threading.Thread(target=dispatcher.run, args=(stop,), daemon=True)
    proxy.freeze()
    with redis.Redis.from_url(broker_url) as broker:
        thread.start()
        assert asked.wait(WITHIN_S)
        began = time.monotonic()
        _queue_fit(stores.database, scene_id)
        _until(lambda: broker.llen(SIMULATION) == 1)
        assert time.monotonic() - began < 10.0
        began = time.monotonic()
        stop.set()
        thread.join(WITHIN_S)
        assert not thread.is_alive() and time.monotonic() - began < STOP_WITHIN_S + 8.0
    assert not done.is_set()
    proxy.thaw()
    assert done.wait(WITHIN_S)
    dispatcher.housekeeping.wait(WITHIN_S)
    app.close()


def test_a_worker_keeps_its_lease_while_the_bucket_is_silent_gives_up_and_does_it_later(
    bucket: tuple[FrozenProxy, dict[str, str]], stores: Stores, scene_id: str, tmp_path: Path
) -> None:
    proxy, where = bucket
    settings = Settings(data_dir=tmp_path / "data", lease_seconds=LEASE_S, **where)
    artifacts = ArtifactStore(settings, SHORT)

    def fit(context: TaskContext, stores: Stores) -> HandlerResult:
        made = artifacts.put_bytes(b"a twin", "twin.npz")
        context.check()  # raises where the lease was not renewed meanwhile
        result = {"parameters": {}, "metrics": {}, "artifacts": [made.model_dump(mode="json")]}
        return HandlerResult(result, made.sha256)

    runtime = Runtime(settings, stores.database, stores, process_owner(), {"fit": fit}.__getitem__)
    shard_id = _queue_fit(stores.database, scene_id)
    proxy.freeze()
    began = time.monotonic()
    assert run_shard(runtime, shard_id) == "retried"
    assert LEASE_S < time.monotonic() - began < WITHIN_S
    with stores.database.session() as session:
        shard = session.get_one(ShardRow, shard_id)
        assert (shard.state, shard.failures, shard.losses) == ("QUEUED", 1, None)
        assert shard.error is not None and shard.error["code"] == "store_write_failed"
        shard.not_before = None
    proxy.thaw()
    _until(lambda: _reads(artifacts))
    assert run_shard(runtime, shard_id) == "done"


def _answers(database: Database) -> bool:
    try:
        database.check()
    except Exception:  # noqa: BLE001 - any fault is one more moment to wait
        return False
    return True


def _reads(artifacts: ArtifactStore) -> bool:
    try:
        artifacts.exists("0" * 64)
    except Exception:  # noqa: BLE001 - any fault is one more moment to wait
        return False
    return True
