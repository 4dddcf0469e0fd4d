"""One supervisor a data folder, and none before the last one's family is gone."""

from __future__ import annotations

import stat
import subprocess
import sys
from pathlib import Path

import pytest

from physworld_services.embedded.folder import (
    AlreadyRunning,
    DataFolder,
    FolderLocks,
    StillAlive,
    write_private,
)


@pytest.fixture
def folder(tmp_path: Path) -> DataFolder:
    folder = DataFolder(tmp_path / "data")
    folder.prepare()
    return folder


def test_a_second_holder_is_told_who_has_it(folder: DataFolder) -> None:
    locks = FolderLocks(folder)
    folder.write_state({"pid": 4711, "api_url": "http://127.0.0.1:1"})
    with pytest.raises(AlreadyRunning, match="pid 4711") as caught:
        FolderLocks(folder)
    assert caught.value.state["api_url"] == "http://127.0.0.1:1"
    locks.close()
    FolderLocks(folder).close()


def test_a_child_that_outlives_its_supervisor_holds_up_the_next_one(folder: DataFolder) -> None:
    locks = FolderLocks(folder)
    locks.wait_until_alone(0.1)
    locks.hold_family()
    command = [sys.executable, "-c", "import sys; sys.stdin.read()"]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=(locks.family_descriptor,))
    locks.leave_family()
    locks.close()
    with child:
        later = FolderLocks(folder)
        with pytest.raises(StillAlive, match="live on after"):
            later.wait_until_alone(0.1)
        child.kill()
        child.wait()
        later.wait_until_alone(5.0)
        later.close()


def test_what_is_private_is_readable_by_its_owner_only(folder: DataFolder) -> None:
    write_private(folder.api_key, "secret\n")
    assert stat.S_IMODE(folder.api_key.stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.run.stat().st_mode) == 0o700
    assert [path.name for path in folder.root.iterdir() if path.name.startswith(".")] == []
