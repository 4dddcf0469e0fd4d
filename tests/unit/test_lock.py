"""The lock: every requirement of every extra is in it, with its version and digests, and pip can be given any part."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CLIENT = tomllib.loads((ROOT / "clients/python/pyproject.toml").read_text())["project"]
ENTRY = re.compile(r"^([a-z0-9.-]+)==[^\s;]+", re.MULTILINE)


def _printed(*extras: str) -> str:
    words = [sys.executable, str(ROOT / "scripts" / "requirements.py"), *extras]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


def _name(requirement: str) -> str:
    return re.split(r"[\[<>=;~! ]", requirement)[0].lower().replace("_", "-").replace(".", "-")


@pytest.mark.parametrize("extra", sorted(PROJECT["optional-dependencies"]))
def test_an_extra_is_locked_whole(extra: str) -> None:
    locked = {name.replace(".", "-") for name in ENTRY.findall(_printed(extra))}
    wanted = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"][extra]]
    wanted += [*CLIENT["dependencies"], *CLIENT["optional-dependencies"]["export"]]
    assert {_name(line) for line in wanted} - {"torch", "physworld"} <= locked


def test_every_entry_has_digests_and_no_address() -> None:
    text = (ROOT / "requirements.lock").read_text()
    entries = re.split(r"^# .*\n", text, flags=re.MULTILINE)[1:]
    assert len(entries) == len(ENTRY.findall(text)) > 100
    for entry in entries:
        assert re.search(r"--hash=sha256:[0-9a-f]{64}\b", entry), entry[:80]
    assert "://" not in text


def test_torch_is_the_cpu_build() -> None:
    assert ENTRY.findall(_printed("torch")) == ["torch"]
    assert "+cpu" in _printed("torch") and "nvidia" not in _printed("api", "sim", "train")


def test_an_extra_that_is_not_there_is_an_error() -> None:
    with pytest.raises(subprocess.CalledProcessError) as refused:
        _printed("nothing")
    assert "'nothing' is no extra" in refused.value.stderr
