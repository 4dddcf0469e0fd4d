"""Starts the parts in their order, keeps them running, says when they serve, and ends them all.

Order: folder locks → database at its newest revision → admin key, signing key → broker, web → once the broker answers:
dispatcher, workers, trainer, inference. Python programs are forks of the supervisor (``forked``). A child that ends is
started again with growing pauses; the broker comes back on its port with its append-only file. The supervisor is one
thread that sleeps between looks; its death by any signal ends every child (Linux: PR_SET_PDEATHSIG) and the next start
carries on from the database.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType

from pydantic import SecretStr
from sqlalchemy.orm import Session

from physworld_schemas.queues import SIMULATION
from physworld_services import interpreter
from physworld_services.embedded import logs
from physworld_services.embedded.broker import Broker, choose_broker
from physworld_services.embedded.child import Child, Program
from physworld_services.embedded.folder import DataFolder, FolderLocks, write_private
from physworld_services.embedded.forked import import_shared
from physworld_storage import signing
from physworld_storage.access import api_keys
from physworld_storage.database import open_database
from physworld_storage.errors import KeyEnded
from physworld_storage.jobs import leases
from physworld_storage.settings import Settings

WATCH_S = 0.2
STARTING_S = 0.05
LOGS_S = 60.0
START_WITHIN_S = 120.0
END_WITHIN_S = 8.0
EARLIER_RUN_WITHIN_S = 15.0
KEY_NAME = "embedded"
READY_FILE = "PHYSWORLD_READY_FILE"
_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))
"""Opens loopback addresses whatever proxy the environment names."""


@dataclass(frozen=True)
class Options:
    """What the command line says.

    Attributes:
        root: the data folder.
        workers: simulation worker processes.
        port: of the web process; 0 takes the last one, or any that is free.
        trainer: whether to run the trainer.
        inference: whether to run the inference service and its worker.
    """

    root: Path
    workers: int = 2
    port: int = 0
    trainer: bool = True
    inference: bool = True


class StartFailed(Exception):
    """A part did not come up; the message names it and quotes its log."""


class Supervisor:
    """The running service of one data folder. Use ``run``."""

    def __init__(self, options: Options, say: Callable[[str], None] = print) -> None:
        self._options = options
        self._say = say
        self._folder = DataFolder(options.root.expanduser().absolute())
        self._children: list[Child] = []
        self._stop = threading.Event()
        self._started_at = datetime.now(UTC)
        self._signing_key = ""

    def run(self) -> None:
        """Start, watch until a signal comes, end everything.

        Raises AlreadyRunning, StartFailed, NoBroker or StillAlive.
        """
        self._folder.prepare()
        locks = FolderLocks(self._folder)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._on_signal)
        try:
            locks.wait_until_alone(EARLIER_RUN_WITHIN_S)
            locks.hold_family()
            with self._listen() as listening, _any_port() as inference:
                try:
                    self._start(locks.family_descriptor, listening, inference)
                    self._watch()
                finally:
                    self._end()
            locks.leave_family()
            locks.wait_until_alone(END_WITHIN_S)
        finally:
            locks.close()

    def _start(self, family: int, listening: socket.socket, inference: socket.socket) -> None:
        environment = {**os.environ, "PHYSWORLD_DATA_DIR": str(self._folder.root), "PYTHONUNBUFFERED": "1"}
        broker = choose_broker(self._folder, environment)
        environment["PHYSWORLD_BROKER_URL"] = broker.url
        if not broker.command:  # somebody else's: others may use it for the same
            environment.setdefault("PHYSWORLD_BROKER_PREFIX", f"physworld-{self._folder.digest}:")
        if self._options.inference:
            environment["PHYSWORLD_INFERENCE_URL"] = f"http://127.0.0.1:{inference.getsockname()[1]}"
        settings = Settings(data_dir=self._folder.root, broker_url=SecretStr(broker.url))
        settings.check()
        self._prepare_database(settings)
        self._url = f"http://127.0.0.1:{listening.getsockname()[1]}"
        if broker.command:
            self._add(Program("broker", broker.command, environment), family)
        web, *others = self._programs(environment, listening, inference)
        self._add(web, family)  # takes longest and needs no broker
        import_shared()
        self._wait_for_broker(broker)
        for program in others:
            self._add(program, family)
        self._write_state(ready=False)
        self._wait_until_ready()
        self._write_state(ready=True)
        self._say(f"PhysWorld is ready at {self._url}/dashboard (Ctrl-C ends it)")
        self._say(f"  API        {self._url}/v1")
        self._say(f"  API docs   {self._url}/docs")
        self._say(f"  API key    {self._folder.api_key}")
        self._say(f"  data       {self._folder.root}")
        if (old := interpreter.warning()) is not None:
            self._say(old)

    def _programs(
        self, environment: dict[str, str], listening: socket.socket, inference: socket.socket
    ) -> list[Program]:
        programs = [
            _server("web", "physworld_services.embedded.web", (), environment, listening),
            self._consumer("dispatcher", "physworld_workers.dispatcher", (), environment, signal.SIGTERM),
        ]
        for number in range(1, self._options.workers + 1):
            name = f"worker-{number}"
            serve = ("--queue", SIMULATION, "--name", name)
            programs.append(self._consumer(name, "physworld_workers", serve, environment))
        if self._options.trainer:
            train = ("--name", "trainer")
            programs.append(self._consumer("trainer", "physworld_services.trainer", train, environment))
        if self._options.inference:
            module = "physworld_services.inference"
            programs.append(_server("inference", module, ("serve",), environment, inference))
            work = ("work", "--name", "planner")
            programs.append(self._consumer("planner", module, work, environment))
        return programs

    def _consumer(
        self,
        name: str,
        module: str,
        arguments: tuple[str, ...],
        environment: dict[str, str],
        stop_signal: signal.Signals = signal.SIGQUIT,
    ) -> Program:
        """A program that writes a file once it works."""
        ready = self._folder.run / f"{name}.ready"
        own = {**environment, READY_FILE: str(ready)}
        command = (sys.executable, "-m", module, *arguments)
        return Program(name, command, own, stop_signal, ready_file=ready, module=module)

    def _add(self, program: Program, family: int) -> None:
        child = Child(program, self._folder.logs / f"{program.name}.log", family)
        child.start()
        self._children.append(child)

    def _prepare_database(self, settings: Settings) -> None:
        database = open_database(settings)
        database.upgrade()
        if not os.environ.get("PHYSWORLD_DATABASE_URL"):
            with database.session() as session:  # alone on it: nobody of an earlier run is left
                leases.recover(session)
        with database.session() as session:
            self._ensure_key(session)
            signer = signing.open_signer(settings)
            signing.register(session, signer)
            self._signing_key = signer.public_key
        database.dispose()

    def _ensure_key(self, session: Session) -> None:
        """The key in the file; one that is gone or has ended is replaced: who has the folder has the service."""
        try:
            if self._folder.api_key.exists():
                api_keys.ensure_key(session, self._folder.api_key.read_text().strip(), KEY_NAME, "admin")
                return
        except KeyEnded as error:
            self._say(f"{self._folder.api_key} holds an ended key: {error}. A new one is written there")
        _, token = api_keys.create_key(session, KEY_NAME, "admin")
        write_private(self._folder.api_key, token + "\n")

    def _listen(self) -> socket.socket:
        """The web process's socket: on the asked port, or on the last one, or on any that is free."""
        candidates = [self._options.port] if self._options.port else [self._folder.last_port(), 0]
        for port in candidates:
            listening = socket.socket()
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listening.bind(("127.0.0.1", port))
            except OSError as error:
                listening.close()
                if port == candidates[-1]:
                    raise StartFailed(f"port {port} on 127.0.0.1 cannot be had: {error}") from error
                continue
            listening.listen(128)
            write_private(self._folder.port, f"{listening.getsockname()[1]}\n")
            return listening
        raise StartFailed("no port to listen on")

    def _wait_for_broker(self, broker: Broker) -> None:
        self._wait("the broker", broker.answers)

    def _wait_until_ready(self) -> None:
        def missing() -> list[str]:
            files = {child.program.name: child.program.ready_file for child in self._children}
            return [name for name, file in files.items() if file is not None and not file.exists()]

        self._wait("the web process", self._web_is_ready)
        self._wait("workers", lambda: not missing())

    def _wait(self, what: str, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + START_WITHIN_S
        while not condition():
            if self._stop.wait(STARTING_S):
                raise Stopped
            for child in self._children:
                child.watch()
                if child.exits >= 3:
                    raise StartFailed(self._obituary(child))
            if time.monotonic() > deadline:
                raise StartFailed(
                    f"{what} did not answer within {START_WITHIN_S:.0f} s; see {self._folder.logs}"
                )

    def _web_is_ready(self) -> bool:
        with suppress(urllib.error.URLError, TimeoutError, ConnectionError):
            with _DIRECT.open(f"{self._url}/health/ready", timeout=2) as answer:
                return bool(answer.status == 200)
        return False

    def _watch(self) -> None:
        """Keep the children running; what a full disk refuses is tried again, and ends nothing."""
        logs_at = time.monotonic() + LOGS_S
        while not self._stop.wait(WATCH_S):
            changed = False
            for child in self._children:
                with self._going_on(f"{child.program.name} is not started yet"):
                    changed |= child.watch()
            due = time.monotonic() > logs_at
            if changed or due:
                with self._going_on("run/state.json is not up to date"):
                    self._write_state(ready=True)
            if due:
                logs_at = time.monotonic() + LOGS_S
                for child in self._children:
                    with self._going_on(f"{child.log.name} is not cut"):
                        logs.rotate(child.log)

    @contextmanager
    def _going_on(self, what: str) -> Iterator[None]:
        """An OSError of the block is said and no more."""
        try:
            yield
        except OSError as error:
            with suppress(OSError):  # what is said may go to a file on the same disk
                self._say(f"PhysWorld goes on, but {what}: {error}")

    def _end(self) -> None:
        """Everything but the broker at once, then the broker, so that workers can give messages back."""
        deadline = time.monotonic() + END_WITHIN_S
        brokers = [child for child in self._children if child.program.name == "broker"]
        others = [child for child in self._children if child not in brokers]
        for group in (others, brokers):
            for child in group:
                child.ask_to_stop()
            for child in group:
                child.wait_or_kill(deadline)
            deadline = max(deadline, time.monotonic() + 2.0)
        self._folder.state.unlink(missing_ok=True)

    def _write_state(self, *, ready: bool) -> None:
        self._folder.write_state(
            {
                "pid": os.getpid(),
                "api_url": self._url,
                "docs_url": f"{self._url}/docs",
                "dashboard_url": f"{self._url}/dashboard",
                "api_key_file": str(self._folder.api_key),
                "signing_key": self._signing_key,
                "started_at": self._started_at.isoformat(),
                "ready": ready,
                "children": {child.program.name: child.pid for child in self._children if child.pid},
            }
        )

    def _obituary(self, child: Child) -> str:
        return (
            f"{child.program.name} ended {child.exits} times while starting (last with code "
            f"{child.last_exit}); the end of {child.log}:\n{logs.tail(child.log)}"
        )

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._stop.set()


def _server(
    name: str, module: str, arguments: tuple[str, ...], environment: dict[str, str], listening: socket.socket
) -> Program:
    """A program that serves on a socket of the supervisor's."""
    descriptor = listening.fileno()
    command = (sys.executable, "-m", module, *arguments, "--fd", str(descriptor))
    return Program(name, command, environment, descriptors=(descriptor,), module=module)


def _any_port() -> socket.socket:
    """A socket that listens on a free loopback port."""
    listening = socket.socket()
    listening.bind(("127.0.0.1", 0))
    listening.listen(128)
    return listening


class Stopped(Exception):
    """A signal came before the service was ready."""
