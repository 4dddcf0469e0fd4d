"""``python -m benchmarks.verification.calibration --json FILE``: what calibration recovers, and what it says of its own
doubt.

Every part is one table of ``docs/calibration_results.md`` (``--docs`` replaces it there); ``--only NAME ...`` runs
some of them. Parts that need the recordings beside the repository are left out, and said so, where these are absent.
With ``--resume DIR`` the fits of recordings keep their finished steps there, and a run that was ended goes on.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import warp as wp

from benchmarks.harness import Report
from benchmarks.verification import (
    calibration_descent,
    calibration_known,
    calibration_measured,
    calibration_shared,
    calibration_sheets,
)

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
PARTS: dict[str, Callable[..., Report]] = {
    "recovery": calibration_known.recovery,
    "descent": calibration_descent.descent,
    "coverage": calibration_known.coverage,
    "identifiability": calibration_known.identifiability,
    "sheets": calibration_sheets.sheets,
    "undeclared": calibration_measured.undeclared,
    "shared": calibration_shared.shared,
}
NEEDS_RECORDINGS = ("undeclared", "shared")
BEGIN, END = "<!-- calibration {}: begin -->", "<!-- calibration {}: end -->"


def main() -> int:
    """Run the chosen parts."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.verification.calibration", description=__doc__
    )
    parser.add_argument("--json", type=Path, default=None, help="write all figures there")
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose tables are replaced")
    parser.add_argument("--only", nargs="*", choices=sorted(PARTS), default=list(PARTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", type=Path, default=None, help="folder of the fits' finished steps")
    given = parser.parse_args()
    wp.config.quiet = True
    figures: dict[str, object] = {}
    for name in given.only:
        if name in NEEDS_RECORDINGS and not SHARED.exists():
            print(f"{name}: left out, the recordings are not at {SHARED}", file=sys.stderr)
            continue
        begun = time.perf_counter()
        measured = {"resume": given.resume} if name in NEEDS_RECORDINGS else {}
        report = PARTS[name](given.seed, SHARED, **measured)
        print(report.markdown(), flush=True)
        figures[name] = {**report.figures, "seconds": time.perf_counter() - begun, "machine": report.machine}
        if given.json is not None:
            given.json.parent.mkdir(parents=True, exist_ok=True)
            given.json.write_text(json.dumps(figures, indent=2) + "\n")
        if given.docs is not None:
            write_part(name, report, given.docs)
    return 0


def write_part(name: str, report: Report, path: Path) -> None:
    """Replace a part's table between its markers, or append it."""
    begin, end = BEGIN.format(name), END.format(name)
    text = path.read_text() if path.exists() else ""
    part = f"{begin}\n{report.markdown()}{end}"
    if begin in text and end in text:
        before, rest = text.split(begin, 1)
        path.write_text(before + part + rest.split(end, 1)[1])
    else:
        path.write_text(f"{text.rstrip()}\n\n{part}\n")


if __name__ == "__main__":
    sys.exit(main())
