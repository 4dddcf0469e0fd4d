"""``python -m benchmarks.hostile_files --count 10000 --seed 0 --json FILE``: what hostile files cost the service.

Starts the real web process on a database and a store of its own, uploads the corpus file by file over HTTP, and reads
off the kernel what the process and those that read for it spent on each. Exits 1 where a file was answered by an error
of the service (5xx) or not at all, went beyond ``MOST_CPU_S`` or ``MOST_BYTES``, or left a trace outside the data
folder.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

from benchmarks.hostile_files.corpus import sound_bundle
from benchmarks.hostile_files.cost import run


def main() -> int:
    """Run and write the ledger."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hostile_files", description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="number of the first file, to repeat one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        report = run(given.count, given.seed, Path(folder), sound_bundle(), given.first)
    print(json.dumps(report, indent=2))
    if given.json:
        given.json.write_text(json.dumps(report, indent=1) + "\n")
    return int(bool(report["beyond"] or report["files_outside"]))


if __name__ == "__main__":
    sys.exit(main())
