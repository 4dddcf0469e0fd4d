"""The embedded broker: private, persistent across kill -9, found in the documented order."""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import redis

from physworld_services.embedded import broker as broker_module
from physworld_services.embedded.broker import NoBroker, choose_broker
from physworld_services.embedded.child import Child, Program
from physworld_services.embedded.folder import DataFolder

WAIT_S = 20.0
AOF_WRITTEN_WITHIN_S = 1.5  # appendfsync everysec, and as much again for a busy machine


@pytest.fixture
def folder(tmp_path: Path) -> DataFolder:
    folder = DataFolder(tmp_path / 'a folder with "quotes"')
    folder.prepare()
    return folder


@pytest.fixture
def running(folder: DataFolder) -> Iterator[tuple[broker_module.Broker, Child]]:
    broker = choose_broker(folder, {})
    family = os.open(folder.run / "family", os.O_CREAT | os.O_RDWR)
    child = Child(Program("broker", broker.command, dict(os.environ)), folder.logs / "broker.log", family)
    child.start()
    _until_answers(broker, child)
    yield broker, child
    child.ask_to_stop()
    child.wait_or_kill(time.monotonic() + 5)
    os.close(family)


def _until_answers(broker: broker_module.Broker, child: Child) -> None:
    deadline = time.monotonic() + WAIT_S
    while not broker.answers():
        child.watch()
        assert time.monotonic() < deadline, child.log.read_text()
        time.sleep(0.05)


def test_messages_survive_kill_9_of_the_broker(running: tuple[broker_module.Broker, Child]) -> None:
    broker, child = running
    with redis.Redis.from_url(broker.url) as client:
        client.lpush("sim", "shard-1", "shard-2")
    time.sleep(AOF_WRITTEN_WITHIN_S)
    assert child.process is not None
    child.process.kill()
    child.process.wait()
    _until_answers(broker, child)
    with redis.Redis.from_url(broker.url) as client:
        assert client.lrange("sim", 0, -1) == [b"shard-2", b"shard-1"]
        assert client.config_get("maxmemory-policy") == {"maxmemory-policy": "noeviction"}


def test_nobody_gets_in_without_the_password(
    running: tuple[broker_module.Broker, Child], folder: DataFolder
) -> None:
    broker, _ = running
    with redis.Redis.from_url(broker.url.replace(broker.url.split("@")[0], "redis://:guess")) as client:
        with pytest.raises(redis.AuthenticationError):
            client.ping()
    assert stat.S_IMODE((folder.run / "broker.conf").stat().st_mode) == 0o600


def test_an_explicit_address_wins(folder: DataFolder) -> None:
    wished = {"PHYSWORLD_BROKER_URL": "redis://elsewhere:1/0", "REDIS_URL": "redis://other:1/0"}
    assert choose_broker(folder, wished) == broker_module.Broker("redis://elsewhere:1/0")


def test_without_a_wheel_the_environment_then_the_path_are_asked(
    folder: DataFolder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(broker_module, "_wheel_binary", lambda: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(NoBroker, match="REDIS_URL"):
        choose_broker(folder, {})
    assert choose_broker(folder, {"REDIS_URL": "redis://other:1/0"}).url == "redis://other:1/0"
    server = tmp_path / "redis-server"
    server.write_text("#!/bin/sh\n")
    server.chmod(0o755)
    assert choose_broker(folder, {}).command[0] == str(server)
