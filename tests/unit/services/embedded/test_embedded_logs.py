"""Log files stay bounded while their writer keeps them open."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import pytest

from physworld_services.embedded.logs import rotate, tail


def test_a_long_log_is_cut_and_its_writer_goes_on_at_the_new_end(tmp_path: Path) -> None:
    log = tmp_path / "worker.log"
    with log.open("ab", buffering=0) as writer:
        writer.write(b"old line\n" * 10)
        assert rotate(log, max_bytes=50)
        writer.write(b"new line\n")
    assert log.read_bytes() == b"new line\n"
    assert (tmp_path / "worker.log.1").read_bytes() == b"old line\n" * 10


def test_a_short_log_is_left_alone(tmp_path: Path) -> None:
    log = tmp_path / "worker.log"
    log.write_text("short\n")
    assert not rotate(log, max_bytes=50)
    assert not rotate(tmp_path / "absent.log")
    assert log.read_text() == "short\n"


def test_three_older_files_are_kept(tmp_path: Path) -> None:
    log = tmp_path / "worker.log"
    for number in range(6):
        log.write_text(f"{number}" * 60)
        rotate(log, max_bytes=50)
    kept = sorted(path.name for path in tmp_path.iterdir())
    assert kept == ["worker.log", "worker.log.1", "worker.log.2", "worker.log.3"]
    assert (tmp_path / "worker.log.3").read_text() == "3" * 60


def test_a_log_that_cannot_be_copied_keeps_all_it_had(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "worker.log"
    older = {"worker.log.1": "1", "worker.log.2": "2", "worker.log": "0" * 60}
    for name, text in older.items():
        (tmp_path / name).write_text(text)

    def full(source: Path, target: Path) -> None:
        target.write_text("0")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(OSError, match="No space"):
        rotate(log, max_bytes=50)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == older


def test_the_tail_of_a_log_is_its_last_lines(tmp_path: Path) -> None:
    log = tmp_path / "worker.log"
    log.write_text("".join(f"line {number}\n" for number in range(1000)))
    assert tail(log, lines=2) == "line 998\nline 999"
    assert tail(tmp_path / "absent.log") == ""
