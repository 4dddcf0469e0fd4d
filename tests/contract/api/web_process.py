"""The web process and the commands beside it as they are started: by their modules, told by the environment."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import httpx

START_WITHIN_S = 60.0


def command(folder: Path, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """``python -m`` with these words, on a data folder; run to its end."""
    return subprocess.run(
        [sys.executable, "-m", *words],
        env=_environment(folder, variables),
        capture_output=True,
        text=True,
        check=False,
        timeout=START_WITHIN_S,
    )


@contextmanager
def web_process(folder: Path, log: Path, **variables: str) -> Iterator[str]:
    """The address of a web process on a data folder, once it is ready; what it writes goes to ``log``."""
    port = free_port()
    with process(folder, log, "physworld_services.web", "--port", str(port), **variables) as running:
        url = f"http://127.0.0.1:{port}"
        until_answer(f"{url}/health/ready", running)
        yield url


@contextmanager
def process(folder: Path, log: Path, *words: str, **variables: str) -> Iterator[subprocess.Popen[bytes]]:
    """``python -m`` with these words in the background, ended with the block."""
    with log.open("ab") as output:
        running = subprocess.Popen(
            [sys.executable, "-m", *words], env=_environment(folder, variables), stdout=output, stderr=output
        )
    try:
        yield running
    finally:
        running.terminate()
        try:
            running.wait(20)
        except subprocess.TimeoutExpired:
            running.kill()
            running.wait()


def free_port() -> int:
    """A port that nobody has just now."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def until_answer(url: str, running: subprocess.Popen[bytes]) -> None:
    """Wait until the address answers 200."""
    deadline = time.monotonic() + START_WITHIN_S
    while time.monotonic() < deadline:
        assert running.poll() is None
        try:
            if httpx.get(url, trust_env=False, timeout=10.0).status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    raise AssertionError(f"{url} does not answer after {START_WITHIN_S:g} s")


def _environment(folder: Path, variables: Mapping[str, str]) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PHYSWORLD_")}
    return {**kept, "PHYSWORLD_DATA_DIR": str(folder), **variables}
