"""A web process of its own for a benchmark: on SQLite and a local folder, with an administrator's key."""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import psutil

START_WITHIN_S = 60.0


@dataclass(frozen=True)
class WebProcess:
    """Where it listens, an administrator's token, its number, and the file that it logs to."""

    url: str
    token: str
    pid: int
    log: Path

    def client(self, timeout: float = 60.0) -> httpx.Client:
        """A client with the administrator's key."""
        headers = {"Authorization": f"Bearer {self.token}"}
        return httpx.Client(base_url=self.url, headers=headers, timeout=timeout, trust_env=False)


@contextmanager
def serving(folder: Path, more: Mapping[str, str] | None = None) -> Iterator[WebProcess]:
    """The process on a data folder, from when it is ready to the end of the block.

    Args:
        more: of its environment.

    Raises RuntimeError where it does not become ready within ``START_WITHIN_S``.
    """
    token = "pw_" + secrets.token_hex(20)
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PHYSWORLD_")}
    environment = {**kept, "PHYSWORLD_DATA_DIR": str(folder), "PHYSWORLD_ADMIN_TOKEN": token, **(more or {})}
    migrate = [sys.executable, "-m", "physworld_services.api.migrate"]
    subprocess.run(migrate, env=environment, check=True, stdout=subprocess.DEVNULL)
    log = folder / "web.log"
    with log.open("ab") as output:
        words = [sys.executable, "-m", "physworld_services.web", "--port", "0"]
        process = subprocess.Popen(words, env=environment, stdout=output, stderr=output)
    try:
        yield WebProcess(_address(process), token, process.pid, log)
    finally:
        process.terminate()
        process.wait(30)


def _address(process: subprocess.Popen[bytes]) -> str:
    deadline = time.monotonic() + START_WITHIN_S
    while time.monotonic() < deadline and process.poll() is None:
        for listening in psutil.Process(process.pid).net_connections("tcp4"):
            if listening.status == psutil.CONN_LISTEN:
                url = f"http://127.0.0.1:{listening.laddr.port}"
                if httpx.get(f"{url}/health/ready", trust_env=False).is_success:
                    return url
        time.sleep(0.1)
    raise RuntimeError(f"the web process did not become ready within {START_WITHIN_S:g} s")
