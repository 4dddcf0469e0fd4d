"""``python -m benchmarks``: run every benchmark and write ``docs/benchmarks.md``.

Each benchmark runs in a process of its own, one thread for BLAS and OpenMP, so that none leaves its threads
or caches to the next; its section in the docs lies between markers and is replaced as a whole.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.harness import REPEATS, Report, read_json, write_section

DOCS = Path(__file__).resolve().parents[1] / "docs" / "benchmarks.md"
BENCHMARKS = (
    "speed.mpm",
    "speed.batch",
    "speed.gradients",
    "verification.transfers",
    "speed.laws",
    "speed.effects",
    "speed.friction",
    "speed.contact",
    "speed.self_contact",
    "speed.world_model",
    "service.factory",
    "service.idle_and_start",
    "service.api_load",
    "service.cancelling",
    "service.import_memory",
    "service.new_user",
    "service.time_left",
    "speed.video",
)
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
HEAD = """# Benchmarks

Printed by `make bench` (`python -m benchmarks`): peers are measured in the same run, on the same machine, in
turn. What is between markers is replaced by the scripts.
"""


def main() -> int:
    """Run the chosen benchmarks; 0 when all of them ran."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", default=[], help=f"of {', '.join(BENCHMARKS)}; none: all")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--docs", type=Path, default=DOCS, help="Markdown file to write")
    given = parser.parse_args()
    unknown = sorted(set(given.names) - set(BENCHMARKS))
    if unknown:
        parser.error(f"no benchmark is called {', '.join(unknown)}")
    if not given.docs.exists():
        given.docs.parent.mkdir(parents=True, exist_ok=True)
        given.docs.write_text(HEAD)
    failed = []
    for name in given.names or BENCHMARKS:
        print(f"== {name}", flush=True)
        report = _run(name, given.repeats, given.seed)
        if report is None:
            failed.append(name)
            continue
        write_section(report, given.docs)
    print(f"written: {given.docs}")
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def _run(name: str, repeats: int, seed: int) -> Report | None:
    """One benchmark in its own process; None where it failed (it has said why)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "report.json"
        options = ["--json", str(path), "--repeats", str(repeats), "--seed", str(seed)]
        command = [sys.executable, "-m", f"benchmarks.{name}", *options]
        done = subprocess.run(command, env={**os.environ, **ONE_THREAD}, check=False)
        return read_json(path) if done.returncode == 0 else None


if __name__ == "__main__":
    sys.exit(main())
