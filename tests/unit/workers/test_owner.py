"""A lease's owner is a process that cannot be mistaken for a later one."""

from __future__ import annotations

import subprocess
import sys

import pytest

from physworld_workers.owner import owner_is_gone, process_owner

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="owners are told apart through /proc")


def _child_owner() -> tuple[subprocess.Popen[str], str]:
    code = (
        "from physworld_workers.owner import process_owner; import sys\n"
        "print(process_owner(), flush=True); sys.stdin.read()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    return process, process.stdout.readline().strip()


def test_the_calling_process_is_not_gone() -> None:
    assert not owner_is_gone(process_owner())


def test_a_killed_process_is_gone_even_before_it_is_waited_for() -> None:
    process, owner = _child_owner()
    with process:
        assert not owner_is_gone(owner)
        process.kill()
        process.wait()
        assert owner_is_gone(owner)


def test_a_reused_pid_is_another_owner() -> None:
    place, _, _ = process_owner().rpartition("/")
    assert owner_is_gone(f"{place}/1")


def test_owners_elsewhere_are_never_judged() -> None:
    assert not owner_is_gone("another-host/4026531836/1/1")
    assert not owner_is_gone("a name without a place")
