"""A fork of the supervisor is what a new interpreter would have been."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from physworld_services.embedded import forked
from physworld_services.embedded.child import Child, Program

pytestmark = pytest.mark.skipif(not forked.AVAILABLE, reason="forks are Linux's")

WAIT_S = 30.0
PROGRAM = """
import json, os, signal, sys
def files():
    places = [f"/proc/self/fd/{number}" for number in os.listdir("/proc/self/fd")]
    return {os.readlink(place) for place in places if os.path.lexists(place)}
print(json.dumps({
    "name": __name__, "arguments": sys.argv[1:], "environment": dict(os.environ), "files": sorted(files()),
    "session": os.getsid(0) == os.getpid(), "sigterm": signal.getsignal(signal.SIGTERM) == signal.SIG_DFL,
    "stdin": sys.stdin.read(),
}), flush=True)
if sys.argv[1] == "exit": sys.exit(int(sys.argv[2]))
if sys.argv[1] == "raise": raise ValueError("as it would be printed")
if sys.argv[1] == "sleep":
    import time
    time.sleep(600)
"""
SUPERVISOR = """
import os, sys, time
from pathlib import Path
from physworld_services.embedded.child import Child, Program
folder = Path(sys.argv[1])
family = os.open(folder / "family", os.O_CREAT | os.O_RDWR)
command = (sys.executable, "-m", "forked_program", "sleep")
child = Child(Program("sleeper", command, dict(os.environ), module="forked_program"), folder / "sleeper.log", family)
sys.path.insert(0, str(folder))
child.start()
print(child.pid, flush=True)
time.sleep(600)
"""


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Child]]:
    (tmp_path / "forked_program.py").write_text(PROGRAM)
    monkeypatch.syspath_prepend(str(tmp_path))
    family = os.open(tmp_path / "family", os.O_CREAT | os.O_RDWR)
    started = []

    def make(*arguments: str) -> Child:
        command = (sys.executable, "-m", "forked_program", *arguments)
        program = Program("forked", command, {"ONLY": "this"}, module="forked_program")
        started.append(Child(program, tmp_path / "forked.log", family))
        started[-1].start()
        return started[-1]

    yield make
    for child in started:
        child.wait_or_kill(time.monotonic())
    os.close(family)


def _said(child: Child) -> dict:
    deadline = time.monotonic() + WAIT_S
    while "\n" not in child.log.read_text():
        assert time.monotonic() < deadline, "nothing was said"
        time.sleep(0.02)
    return json.loads(child.log.read_text().splitlines()[0])


def test_it_has_a_session_an_environment_and_files_of_its_own(
    start: Callable[..., Child], tmp_path: Path
) -> None:
    with (tmp_path / "lock of the supervisor").open("w"):
        said = _said(start("sleep"))
    assert said["name"] == "__main__" and said["arguments"] == ["sleep"]
    assert said["environment"] == {"ONLY": "this"}
    assert said["session"] and said["sigterm"] and said["stdin"] == ""
    known = {str(tmp_path / "family"), str(tmp_path / "forked.log"), "/dev/null"}
    assert {file for file in said["files"] if not file.startswith("/proc/")} == known


@pytest.mark.parametrize(("arguments", "code"), [(("exit", "0"), 0), (("exit", "3"), 3), (("raise",), 1)])
def test_its_exit_code_is_known_and_nothing_of_the_supervisor_runs_in_it(
    start: Callable[..., Child], arguments: tuple[str, ...], code: int
) -> None:
    child = start(*arguments)
    assert child.process is not None and child.process.wait(WAIT_S) == code
    if code == 1:
        assert "ValueError: as it would be printed" in child.log.read_text()


def test_a_signal_is_its_exit_code_and_it_is_started_again(start: Callable[..., Child]) -> None:
    child = start("sleep")
    _said(child)
    first = child.pid
    child.ask_to_stop()
    deadline = time.monotonic() + WAIT_S
    while not (child.watch() and child.pid is not None):
        assert time.monotonic() < deadline, "not started again"
        time.sleep(0.02)
    assert (child.exits, child.last_exit) == (1, -signal.SIGTERM)
    assert child.pid != first


def test_it_dies_with_a_killed_supervisor(tmp_path: Path) -> None:
    (tmp_path / "forked_program.py").write_text(PROGRAM)
    command = [sys.executable, "-c", SUPERVISOR, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as supervisor:
        assert supervisor.stdout is not None
        child = psutil.Process(int(supervisor.stdout.readline()))
        supervisor.kill()
        supervisor.wait()
        psutil.wait_procs([child], WAIT_S)
        assert not child.is_running() or child.status() == psutil.STATUS_ZOMBIE


def test_a_supervisor_has_loaded_nothing_that_computes_or_migrates() -> None:
    """Threads of NumPy, torch and Warp do not survive a fork, and each part sets their number for itself."""
    code = (
        "import sys, threading, physworld_services.embedded.__main__\n"
        "from physworld_services.embedded.forked import import_shared\n"
        "import_shared()\n"
        "heavy = {'numpy', 'torch', 'warp', 'scipy', 'zarr', 'alembic'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "assert threading.active_count() == 1\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_web_process_loads_arrays_stores_and_numerics_when_they_are_asked_for() -> None:
    code = (
        "import sys, physworld_services.web\n"
        "heavy = {'torch', 'warp', 'scipy', 'zarr', 'alembic', 'celery'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
