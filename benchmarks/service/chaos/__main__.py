"""``python -m benchmarks.service.chaos --kills N --seed S [--deployment embedded|distributed] [--minutes M] --json
FILE``.

Starts the service on a folder of its own, keeps it busy with pipelines, kills N of its processes and does other harm
beside, stops the harm, waits for all that was begun, and prints a ledger. Exit codes: 0 nothing was lost, doubled or
corrupted and every kill was made; 1 otherwise; 2 the deployment cannot be started on this machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.harness import Report, write_json, write_section
from benchmarks.service.chaos import ledger
from benchmarks.service.chaos.distributed import Distributed
from benchmarks.service.chaos.embedded import Embedded
from benchmarks.service.chaos.processes import CannotRun
from benchmarks.service.chaos.run import LEASE_S, ORPHAN_S, run

DEPLOYMENTS = {"embedded": Embedded, "distributed": Distributed}
CANNOT_RUN = 2
ROWS = (
    ("kills", "processes killed (SIGKILL)"),
    ("pipelines", "pipelines that were accepted"),
    ("pipelines_lost", "of them lost"),
    ("pipelines_doubled", "begun twice"),
    ("jobs", "jobs"),
    ("jobs_lost", "failed or never ended"),
    ("pipelines_retried", "pipelines refused for want of disk and retried"),
    ("episodes_expected", "episodes expected"),
    ("episodes_lost", "lost"),
    ("episodes_doubled", "there twice"),
    ("episodes_corrupt", "not what was committed"),
    ("models_published", "models published"),
    ("models_missing", "pipelines without a model"),
    ("models_doubled", "published twice"),
    ("models_corrupt", "files of models that are not what their digests say"),
    ("files_missing", "files that a row names and the store lacks"),
    ("orphans", "files that no row names"),
    ("shards_tried_again", "shards that were begun again"),
    ("most_attempts", "attempts at one shard, at most"),
    ("seconds", "seconds in all"),
)


def main(arguments: list[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.service.chaos", description=__doc__)
    parser.add_argument("--kills", type=int, required=True, help="how many processes to kill")
    parser.add_argument("--seed", type=int, default=0, help="of the faults")
    parser.add_argument("--deployment", choices=sorted(DEPLOYMENTS), default="embedded")
    parser.add_argument(
        "--minutes", type=float, default=60.0, help="at most so long under faults (default: 60)"
    )
    parser.add_argument(
        "--settle", type=float, default=600.0, help="seconds to wait for the rest (default: 600)"
    )
    parser.add_argument("--episodes", type=int, default=24, help="of each pipeline (default: 24)")
    parser.add_argument("--json", type=Path, default=None, help="write the ledger there")
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section to replace")
    parser.add_argument("--keep", type=Path, default=None, help="a new folder that keeps the logs")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="physworld-chaos-", ignore_cleanup_errors=True) as temporary:
        folder = given.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        service = DEPLOYMENTS[given.deployment](folder, LEASE_S, ORPHAN_S)
        try:
            found = run(
                service,
                folder,
                kills=given.kills,
                seed=given.seed,
                minutes=given.minutes,
                episodes=given.episodes,
                settle_s=given.settle,
            )
        except CannotRun as error:
            print(f"the {given.deployment} deployment cannot be tried here: {error}", file=sys.stderr)
            return CANNOT_RUN
    report = _report(found, given.deployment, given.seed)
    print(report.markdown())
    if given.json is not None:
        write_json(report, given.json)
    if given.docs is not None:
        write_section(report, given.docs)
    faults = ledger.faults_of(found)
    if faults:
        print(f"not kept: {json.dumps(faults)}; {json.dumps(found['lost_because'])}", file=sys.stderr)
    if found["kills"] < given.kills:
        print(f"{found['kills']} of {given.kills} kills in {given.minutes:g} minutes", file=sys.stderr)
    return 1 if faults or found["kills"] < given.kills else 0


def _report(found: dict[str, Any], deployment: str, seed: int) -> Report:
    """The ledger as a table."""
    rows = [[words, f"{found[key]:g}"] for key, words in ROWS]
    return Report(
        name=f"chaos.{deployment}",
        title=f"Chaos, {deployment}: {found['kills']} kills",
        figures={"deployment": deployment, **found},
        header=["what", "count"],
        rows=rows,
        notes=[
            f"Killed: {_listed(found['kills_by_target'])}.",
            f"Beside the kills: {_listed(found['faults'])}.",
            f"Skipped, because this machine cannot play them or the target did not run: {_listed(found['skipped'])}.",
            f"Files that no row names: {_listed(found['orphans_by_kind'])}.",
            f"Leases of {LEASE_S:g} s; a file without a row goes after {ORPHAN_S:g} s; "
            f"{found['harmed_s']:g} s under faults.",
        ],
        seed=seed,
    )


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {number}" for name, number in sorted(counts.items())) or "none"


if __name__ == "__main__":
    sys.exit(main())
