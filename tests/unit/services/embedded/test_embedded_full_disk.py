"""A full disk: the supervisor goes on with what it has, and its children are started again."""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from physworld_services.embedded import child as child_module
from physworld_services.embedded import logs, supervisor
from physworld_services.embedded.__main__ import main
from physworld_services.embedded.child import Child, Program
from physworld_services.embedded.supervisor import Options, Supervisor
from physworld_storage.errors import DatabaseUnavailable

WITHIN_S = 20.0


def _full(*arguments: object, **named: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def _child(tmp_path: Path) -> Child:
    code = "import time; time.sleep(600)"
    program = Program("sleeper", (sys.executable, "-c", code), dict(os.environ))
    return Child(program, tmp_path / "sleeper.log", os.open(tmp_path / "family", os.O_CREAT | os.O_RDWR))


def _until(condition) -> None:
    deadline = time.monotonic() + WITHIN_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.parametrize(
    "error",
    [OSError(errno.ENOSPC, "No space left on device"), DatabaseUnavailable("database or disk is full")],
)
def test_a_start_on_a_full_disk_says_so_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception
) -> None:
    def refused(self: Supervisor) -> None:
        raise error

    monkeypatch.setattr(Supervisor, "run", refused)
    assert main(["--data", str(tmp_path / "new")]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"the disk of {tmp_path / 'new'} is full" in said and "bytes are free" in said


def test_a_data_folder_that_is_a_file_is_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "taken").write_text("")
    assert main(["--data", str(tmp_path / "taken")]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"PhysWorld could not start: the data folder {tmp_path / 'taken'}: ")
    assert said.count("\n") == 1


def test_a_child_whose_log_cannot_be_cut_is_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    child = _child(tmp_path)
    monkeypatch.setattr(logs, "rotate", _full)
    child.start()
    assert child.pid is not None
    child.wait_or_kill(time.monotonic())
    os.close(child.family_descriptor)


def test_the_supervisor_outlives_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []

    def say(text: str) -> None:
        said.append(text)
        _full()

    watched = Supervisor(Options(tmp_path), say)
    child = _child(tmp_path)
    watched._children.append(child)
    watched._url = "http://127.0.0.1:1"
    child.start()
    monkeypatch.setattr(logs, "rotate", _full)
    monkeypatch.setattr(watched._folder.__class__, "write_state", _full)
    monkeypatch.setattr(supervisor, "LOGS_S", 0.5)
    monkeypatch.setattr(child_module, "LONGEST_PAUSE_S", 0.5)
    thread = threading.Thread(target=watched._watch)
    thread.start()
    try:
        _until(lambda: any("sleeper.log is not cut" in text for text in said))
        first = child.pid
        assert first is not None
        with monkeypatch.context() as patch:
            patch.setattr(Child, "start", _full)
            os.kill(first, signal.SIGKILL)
            _until(lambda: any("sleeper is not started yet: [Errno 28]" in text for text in said))
        _until(lambda: child.pid not in (None, first))
        _until(lambda: any("state.json is not up to date" in text for text in said))
        assert thread.is_alive()
    finally:
        watched._stop.set()
        thread.join()
        child.wait_or_kill(time.monotonic())
        os.close(child.family_descriptor)
