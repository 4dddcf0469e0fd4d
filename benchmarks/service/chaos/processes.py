"""Processes of our own: started to die with us, found again by what they are, and hurt by signals."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[3]
PR_SET_PDEATHSIG = 1


class CannotRun(Exception):
    """This machine lacks what a deployment needs; the message says what."""


def start(
    command: Sequence[str], environment: Mapping[str, str], log: Path, user: str | None = None
) -> subprocess.Popen[bytes]:
    """Start a process in a session of its own; it is killed when the calling thread ends."""
    with log.open("ab") as output:
        return subprocess.Popen(
            list(command),
            cwd=ROOT,
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=_die_with_parent if sys.platform == "linux" else None,
            user=user,
        )


def environment(**more: str) -> dict[str, str]:
    """This process's environment without any address of a broker, a database or a store."""
    kept = {name: text for name, text in os.environ.items() if not name.startswith(("PHYSWORLD_", "REDIS_"))}
    return {**kept, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", **more}


def end(process: subprocess.Popen[bytes] | None, number: signal.Signals, seconds: float) -> None:
    """Ask a process to end, and kill its session when it does not in time."""
    if process is None:
        return
    if process.poll() is None:
        process.send_signal(number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(seconds)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def alive(pid: int | None) -> psutil.Process | None:
    """The process, or None where it has ended."""
    if pid is None:
        return None
    try:
        process = psutil.Process(pid)
        return process if process.status() != psutil.STATUS_ZOMBIE else None
    except psutil.NoSuchProcess:
        return None


def child_of(process: psutil.Process | None) -> psutil.Process | None:
    """The pool process of a worker: its only child, None where it has none at the moment."""
    if process is None:
        return None
    try:
        children = process.children()
    except psutil.NoSuchProcess:
        return None
    return children[0] if children else None


def kill(process: psutil.Process | None) -> bool:
    """SIGKILL; whether there was anything to kill."""
    if process is None:
        return False
    try:
        process.kill()
    except psutil.NoSuchProcess:
        return False
    return True


def stop(process: psutil.Process | None) -> Callable[[], None] | None:
    """SIGSTOP; what lets it go on, None where it does not run. Safe against a number that was given again."""
    if process is None:
        return None

    def go_on() -> None:
        with suppress(psutil.NoSuchProcess):
            process.resume()

    try:
        process.suspend()
    except psutil.NoSuchProcess:
        return None
    return go_on


def free_port() -> int:
    """A loopback port that was free a moment ago."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


def until(condition: Callable[[], bool], what: str, seconds: float) -> None:
    """Wait for a condition. Raises CannotRun with ``what`` when it does not come."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise CannotRun(f"{what} within {seconds:.0f} s")
        time.sleep(0.1)


def _die_with_parent() -> None:
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
