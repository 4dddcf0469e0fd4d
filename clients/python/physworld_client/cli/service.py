"""Which service a command talks to: a given one, the one on the data folder, or one started for it.

The embedded service writes ``DATA/run/state.json`` (its addresses, its process id) and ``DATA/api-key``. It
is started as ``python -m physworld_services.embedded``: the client imports nothing of it, and the SDK installs alone.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from physworld_client.client import Client
from physworld_client.errors import PhysWorldError

START_TIMEOUT_S = 180.0
STOP_TIMEOUT_S = 30.0
POLL_S = 0.1
MAX_RETRIES = 2
LOG_TAIL_LINES = 15
PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Address:
    """Where a service is and how to get in.

    Attributes:
        dashboard_url: what people look at.
        data: the data folder of an embedded service; None for a remote one.
        signing_key: public key in base64 that an embedded service says it signs with, in its own data folder.
    """

    url: str
    token: str | None
    dashboard_url: str
    data: Path | None = None
    signing_key: str | None = None

    def client(self, max_retries: int = MAX_RETRIES) -> Client:
        """A client of it; the keys of an embedded service are pinned for its data folder: its port may change."""
        known_as = None if self.data is None else str(self.data)
        return Client(self.url, self.token, max_retries=max_retries, known_as=known_as)


def data_folder(given: Path | None) -> Path:
    """The data folder: given, ``PHYSWORLD_DATA_DIR``, or ``~/.local/share/physworld``."""
    chosen = given or Path(os.environ.get("PHYSWORLD_DATA_DIR") or "~/.local/share/physworld")
    return chosen.expanduser().absolute()


def find(url: str | None, token: str | None, data: Path | None) -> Address | None:
    """The service of ``--url``, of ``--data``, else of ``PHYSWORLD_URL``, else of the usual data folder; or None.

    What was given on the command line counts before the environment.
    """
    if url is None and data is None:
        url = os.environ.get("PHYSWORLD_URL")
    if url:
        base = url.rstrip("/")
        return Address(base, token or os.environ.get("PHYSWORLD_TOKEN"), f"{base}/dashboard")
    return running_on(data_folder(data))


def require(url: str | None, token: str | None, data: Path | None) -> Address:
    """The service that ``find`` finds.

    Raises:
        PhysWorldError: no address was given and none runs on the data folder.
    """
    address = find(url, token, data)
    if address is None:
        raise PhysWorldError(
            f"no service runs on {data_folder(data)}: start it with `physworld up`, or give --url and --token"
        )
    return address


def connect(url: str | None, token: str | None, data: Path | None) -> Client:
    """A client of the service that ``find`` finds. Raises PhysWorldError without one."""
    return require(url, token, data).client()


class Embedded:
    """An embedded service started by this command.

    Args:
        data: its data folder.
        workers: simulation workers.
        stays: whether it outlives this command; otherwise it ends with it, however the command ends.
    """

    def __init__(self, data: Path, workers: int, *, stays: bool) -> None:
        logs = data / "logs"
        for folder in (data, logs):  # a parent that is made on the way would be readable by all
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.data = data
        self.log = logs / "supervisor.log"
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                embedded_command(data, workers, 0),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=None if stays else _end_with_parent(os.getpid()),
            )

    def wait_until_ready(self) -> Address:
        """Waits until the service answers.

        Raises:
            PhysWorldError: it ended, or was not ready within ``START_TIMEOUT_S``; with the end of its log.
        """
        end = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < end:
            address = running_on(self.data, pid=self.process.pid)
            if address is not None:
                return address
            code = self.process.poll()
            if code is not None:
                raise PhysWorldError(f"the service ended with code {code} while starting:\n{self._tail()}")
            time.sleep(POLL_S)
        self.stop()
        raise PhysWorldError(f"the service was not ready after {START_TIMEOUT_S:g} s:\n{self._tail()}")

    def alive(self) -> bool:
        """Whether the supervisor still runs."""
        return self.process.poll() is None

    def stop(self) -> None:
        """Ends the service and everything it started."""
        self.process.terminate()
        try:
            self.process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def _tail(self) -> str:
        lines = self.log.read_text(errors="replace").splitlines()[-LOG_TAIL_LINES:]
        return "\n".join([*lines, f"(the whole log: {self.log})"])


def embedded_command(data: Path, workers: int, port: int) -> list[str]:
    """The command that runs the embedded service in the foreground."""
    options = ["--data", str(data), "--workers", str(workers), "--port", str(port)]
    return [sys.executable, "-m", "physworld_services.embedded", *options]


def state_of(data: Path) -> dict[str, Any]:
    """What the embedded service on a data folder wrote of itself; empty where none runs."""
    try:
        state: dict[str, Any] = json.loads((data / "run" / "state.json").read_bytes())
    except (FileNotFoundError, json.JSONDecodeError):
        return {}
    return state


def running_on(data: Path, pid: int | None = None) -> Address | None:
    """The service that runs on a data folder and answers; None when there is none (or not as ``pid``)."""
    state = state_of(data)
    if not state or not state.get("ready", True) or (pid is not None and state.get("pid") != pid):
        return None
    url = str(state["api_url"]).rstrip("/")
    try:
        with httpx.Client(trust_env=False, timeout=5.0) as http:
            if http.get(f"{url}/health/live").status_code != 200:
                return None
    except httpx.TransportError:
        return None
    try:
        token = Path(state["api_key_file"]).read_text().strip()
    except OSError as error:
        raise PhysWorldError(f"the API key cannot be read: {error}") from error
    return Address(url, token, str(state["dashboard_url"]), data, state.get("signing_key") or None)


def _end_with_parent(parent: int) -> Callable[[], None] | None:
    """What the child does before it becomes the service: asks the kernel for SIGTERM at our death (Linux)."""
    if sys.platform != "linux":
        return None
    library = ctypes.CDLL(None, use_errno=True)

    def ask() -> None:
        library.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:
            os._exit(1)

    return ask
