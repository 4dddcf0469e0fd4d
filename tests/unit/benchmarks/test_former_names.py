"""Commands of benchmarks that have moved run under the names that they were published with."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

FORMER = {
    "chaos": "service.chaos.__main__",
    "hidden_effects": "trace.hidden_effects",
    "paper_tables": "paper.tables",
    "trace_outside": "trace.outside",
    "trace_power": "trace.power",
    "trace_real": "trace.real",
}
FIND = """
import importlib.util, sys
for name in sys.argv[1:]:
    spec = importlib.util.find_spec(f"benchmarks.{name}")
    code = spec.loader.get_code(spec.name)
    print(code.co_filename, "main" in code.co_names)
"""


def python(repository: Path, *words: str) -> str:
    command = [sys.executable, *words]
    return subprocess.run(command, cwd=repository, check=True, capture_output=True, text=True).stdout


def test_every_former_name_is_the_command_where_it_is_now(repository: Path):
    pairs = [name for item in FORMER.items() for name in item]
    found = python(repository, "-c", FIND, *pairs).splitlines()
    assert len(found) == 2 * len(FORMER)
    assert found[::2] == found[1::2]
    assert all(line.endswith(" True") for line in found)


@pytest.mark.parametrize("name", ["chaos", "trace_power"])
def test_a_former_name_runs(repository: Path, name: str):
    assert python(repository, "-m", f"benchmarks.{name}", "--help").startswith("usage: python -m benchmarks.")


def test_a_name_that_never_was_is_not_found(repository: Path):
    found = python(repository, "-c", "import importlib.util as u; print(u.find_spec('benchmarks.no_such'))")
    assert found.strip() == "None"
