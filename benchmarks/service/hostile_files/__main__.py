"""``python -m benchmarks.service.hostile_files --count 10000 --seed 0 --json FILE``: what hostile files cost the
service.

Starts the real web process on a database and a store of its own, uploads every known bomb and then the corpus, file by
file, over HTTP, and reads off the kernel what the process and those that read for it spent on each. Exits 1 where a
file was answered by an error of the service (5xx) or not at all, went beyond ``MOST_CPU_S`` or ``MOST_BYTES``, or left
a trace outside the data folder. The working directory is watched as well: change no file of it while this runs.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

from benchmarks.harness import write_section
from benchmarks.service.hostile_files.corpus import sound_bundle
from benchmarks.service.hostile_files.cost import run
from benchmarks.service.hostile_files.ledger import Ledger


def main() -> int:
    """Run, and write the ledger, also of a run that breaks off."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.service.hostile_files", description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="number of the first file, to repeat one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the ledger there")
    parser.add_argument("--section", type=Path, help="Markdown file whose section hostile_files to replace")
    given = parser.parse_args()
    ledger = Ledger(given.seed, given.count)
    try:
        with tempfile.TemporaryDirectory() as folder:
            run(given.count, given.seed, Path(folder), sound_bundle(), given.first, ledger)
    finally:
        print(ledger.table().markdown())
        if given.json:
            given.json.write_text(json.dumps(ledger.report(), indent=1) + "\n")
    if given.section:
        write_section(ledger.table(), given.section)
    for trace in (*ledger.beyond, *ledger.outside):
        print(trace, file=sys.stderr)
    return int(bool(ledger.beyond or ledger.outside))


if __name__ == "__main__":
    sys.exit(main())
