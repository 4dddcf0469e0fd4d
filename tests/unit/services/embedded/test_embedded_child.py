"""Children die with their supervisor, take their own children along, and are started again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from physworld_services.embedded.child import Child, Program

WAIT_S = 20.0
SLEEPER = "import time; time.sleep(600)"
PARENT_OF_SLEEPER = (
    "import subprocess, sys, time\n"
    "p = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
    "print(p.pid, flush=True); time.sleep(600)"
)


def _child(tmp_path: Path, code: str) -> Child:
    program = Program("sleeper", (sys.executable, "-c", code), dict(os.environ))
    return Child(program, tmp_path / "sleeper.log", os.open(tmp_path / "family", os.O_CREAT | os.O_RDWR))


def _until(condition, what: str) -> None:
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def _alive(pid: int) -> bool:
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE


def test_a_child_that_ends_is_started_again_after_a_pause(tmp_path: Path) -> None:
    child = _child(tmp_path, SLEEPER)
    child.start()
    first = child.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    _until(lambda: child.watch() and child.pid is not None, "not started again")
    assert child.pid != first
    assert (child.exits, child.last_exit) == (1, -signal.SIGKILL)
    assert child.wait_or_kill(time.monotonic()) is False
    os.close(child.family_descriptor)


def test_a_killed_child_takes_its_own_children_along(tmp_path: Path) -> None:
    child = _child(tmp_path, PARENT_OF_SLEEPER)
    child.start()
    _until(lambda: child.log.read_text().strip(), "no grandchild")
    grandchild = int(child.log.read_text())
    assert child.pid is not None
    os.kill(child.pid, signal.SIGKILL)
    _until(child.watch, "exit not noticed")
    _until(lambda: not _alive(grandchild), "the grandchild lives on")
    child.wait_or_kill(time.monotonic())
    os.close(child.family_descriptor)


@pytest.mark.skipif(sys.platform != "linux", reason="PR_SET_PDEATHSIG is Linux's")
def test_a_child_dies_with_a_killed_supervisor(tmp_path: Path) -> None:
    code = (
        "import os, sys, time; from pathlib import Path; from physworld_services.embedded.child import Child, Program\n"
        f"family = os.open({str(tmp_path / 'family')!r}, os.O_CREAT | os.O_RDWR)\n"
        f"program = Program('sleeper', (sys.executable, '-c', {SLEEPER!r}), dict(os.environ))\n"
        f"child = Child(program, Path({str(tmp_path / 'sleeper.log')!r}), family)\n"
        "child.start(); print(child.pid, flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as supervisor:
        assert supervisor.stdout is not None
        pid = int(supervisor.stdout.readline())
        assert _alive(pid)
        supervisor.kill()
        supervisor.wait()
        _until(lambda: not _alive(pid), "the child lives on")
