"""Benchmarks: what prints every number in ``docs/benchmarks.md``, with peers measured in the same run.

Commands that were published before the benchmarks had rooms (ADR 36) go on under their names: ``python -m
benchmarks.chaos`` runs ``benchmarks/service/chaos/__main__.py``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType

FORMER = {
    "chaos": "service/chaos/__main__.py",
    "hidden_effects": "trace/hidden_effects.py",
    "paper_tables": "paper/tables.py",
    "trace_outside": "trace/outside.py",
    "trace_power": "trace/power.py",
    "trace_real": "trace/real.py",
}
"""Former names of commands, and the files that they run."""


class _FormerNames(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        package, _, name = fullname.rpartition(".")
        if package != __name__ or name not in FORMER:
            return None
        return spec_from_file_location(fullname, Path(__file__).parent / FORMER[name])


sys.meta_path.append(_FormerNames())
