"""Work reaches the broker, and comes back when the broker or a worker loses it. With a real broker."""

from __future__ import annotations

import base64
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta

import pytest
import redis
from pydantic import SecretStr
from sqlalchemy import event

import physworld_workers.dispatcher
from physworld_schemas.fit import FitConfig
from physworld_schemas.queues import SIMULATION
from physworld_storage import idempotency
from physworld_storage.jobs import jobs, leases
from physworld_storage.settings import Settings
from physworld_storage.tables import IdempotencyRow, ShardRow
from physworld_workers.app import create_app
from physworld_workers.dispatcher import FORGET_EVERY_S, IDLE_SWEEP_S, MAX_DEPTH, Dispatcher
from physworld_workers.stores import Stores

pytestmark = pytest.mark.slow

WITHIN_S = 20.0


@pytest.fixture
def settings(tmp_path, broker_url: str) -> Settings:
    return Settings(data_dir=tmp_path / "data", broker_url=SecretStr(broker_url))


@pytest.fixture
def broker(broker_url: str) -> Iterator[redis.Redis]:
    with redis.Redis.from_url(broker_url) as client:
        yield client


@pytest.fixture
def dispatching(settings: Settings, stores: Stores) -> Iterator[None]:
    app = create_app(settings)
    stop = threading.Event()
    thread = threading.Thread(target=Dispatcher(settings, stores.database, app).run, args=(stop,))
    thread.start()
    yield
    stop.set()
    thread.join()
    app.close()


def _create_fits(stores: Stores, scene_id: str, count: int) -> None:
    with stores.database.session() as session:
        for _ in range(count):
            jobs.create_fit(session, scene_id, FitConfig())


def _shards(stores: Stores) -> list[ShardRow]:
    with stores.database.reading() as session:
        return session.query(ShardRow).all()


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WITHIN_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.usefixtures("dispatching")
def test_a_new_shard_is_published_with_its_id_only(
    stores: Stores, scene_id: str, broker: redis.Redis
) -> None:
    _create_fits(stores, scene_id, 1)
    _until(lambda: broker.llen(SIMULATION) == 1)
    message = broker.lindex(SIMULATION, 0)
    _until(lambda: _shards(stores)[0].published_at is not None)
    assert _shards(stores)[0].id.encode() in _body(message)


@pytest.mark.usefixtures("dispatching")
def test_messages_that_the_broker_lost_are_published_again(
    stores: Stores, scene_id: str, broker: redis.Redis
) -> None:
    _create_fits(stores, scene_id, 3)
    _until(lambda: broker.llen(SIMULATION) == 3)
    broker.flushall()
    _until(lambda: broker.llen(SIMULATION) == 3)


@pytest.mark.usefixtures("dispatching")
def test_a_broker_that_takes_nothing_is_waited_for(
    stores: Stores, scene_id: str, broker: redis.Redis, caplog: pytest.LogCaptureFixture
) -> None:
    broker.config_set("maxmemory", 1)  # as a disk that is full, it makes writing commands fail and no others
    _create_fits(stores, scene_id, 1)
    _until(lambda: "broker away or full" in caplog.text)
    broker.config_set("maxmemory", 0)
    _until(lambda: broker.llen(SIMULATION) == 1)


def test_idempotency_keys_of_more_than_a_day_ago_are_forgotten_once_an_hour(
    settings: Settings, stores: Stores, monkeypatch: pytest.MonkeyPatch
) -> None:
    def keep(name: str, age: timedelta) -> None:
        with stores.database.session() as session:
            assert idempotency.reserve(session, "key_1", name, "fingerprint") is None
            session.get_one(IdempotencyRow, ("key_1", name)).created_at = datetime.now(UTC) - age

    def kept() -> set[str]:
        with stores.database.reading() as session:
            return {row.key for row in session.query(IdempotencyRow)}

    keep("old", timedelta(hours=25))
    keep("fresh", timedelta(hours=23))
    app = create_app(settings)
    dispatcher = Dispatcher(settings, stores.database, app)
    dispatcher.tick()
    assert kept() == {"fresh"}
    keep("old again", timedelta(hours=25))
    dispatcher.tick()
    assert kept() == {"fresh", "old again"}
    later = time.monotonic() + FORGET_EVERY_S
    monkeypatch.setattr(time, "monotonic", lambda: later)
    dispatcher.tick()
    assert kept() == {"fresh"}
    dispatcher.housekeeping.wait(WITHIN_S)
    app.close()


@pytest.mark.usefixtures("dispatching")
def test_the_broker_is_not_filled_with_a_large_dataset(
    stores: Stores, scene_id: str, broker: redis.Redis
) -> None:
    _create_fits(stores, scene_id, MAX_DEPTH + 20)
    _until(lambda: broker.llen(SIMULATION) == MAX_DEPTH)
    time.sleep(1.5)
    assert broker.llen(SIMULATION) == MAX_DEPTH


def test_a_dispatcher_without_work_asks_the_database_seldom_and_the_broker_never(
    settings: Settings, stores: Stores, broker: redis.Redis
) -> None:
    statements: list[str] = []
    app, stop = create_app(settings), threading.Event()
    dispatcher = Dispatcher(settings, stores.database, app)
    dispatcher.tick()  # the first one forgets old keys too, and has the store tidied up
    dispatcher.housekeeping.wait(WITHIN_S)
    event.listen(stores.database.engine, "before_cursor_execute", lambda *given: statements.append(given[2]))
    commands = broker.info("stats")["total_commands_processed"]
    thread = threading.Thread(target=dispatcher.run, args=(stop,))
    began = time.monotonic()
    thread.start()
    time.sleep(3 * IDLE_SWEEP_S)
    stop.set()
    thread.join()
    app.close()
    looks = (time.monotonic() - began) / IDLE_SWEEP_S
    asked = [statement for statement in statements if not statement.startswith("BEGIN")]
    # Two when it begins to listen, then one every two seconds, at the first and at the last moment too.
    assert 1 <= len(asked) <= looks + 3, asked
    assert broker.info("stats")["total_commands_processed"] - commands <= 1  # this question itself


@pytest.mark.usefixtures("dispatching")
def test_a_shard_that_is_queued_while_nobody_looks_is_published_without_waiting_for_the_next_look(
    stores: Stores, scene_id: str, broker: redis.Redis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(physworld_workers.dispatcher, "IDLE_SWEEP_S", 3600.0)
    time.sleep(IDLE_SWEEP_S + 1.0)  # the look that sets the next one an hour from now
    _create_fits(stores, scene_id, 1)
    _until(lambda: broker.llen(SIMULATION) == 1)


@pytest.mark.usefixtures("dispatching")
@pytest.mark.skipif(sys.platform != "linux", reason="owners are told apart through /proc")
def test_the_shard_of_a_killed_worker_comes_back_before_its_lease_ends(
    stores: Stores, scene_id: str, broker: redis.Redis
) -> None:
    code = "from physworld_workers.owner import process_owner; print(process_owner(), flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as worker:
        assert worker.stdout is not None
        owner = worker.stdout.readline().strip()
        _create_fits(stores, scene_id, 1)
        with stores.database.session() as session:
            lease = leases.claim(session, _shards(stores)[0].id, owner, 3600.0)
        assert lease is not None
        time.sleep(1.5)
        assert _shards(stores)[0].state == "RUNNING"
        worker.kill()
        worker.wait()
        _until(lambda: _shards(stores)[0].state == "QUEUED")
        _until(lambda: broker.llen(SIMULATION) >= 1)


def _body(message: bytes) -> bytes:
    """The body of a kombu message, decoded."""
    return base64.b64decode(json.loads(message)["body"])
