"""``python -m benchmarks.trace.outside --json FILE``: what a trace says where something acts that its library lacks.

Five such things (:mod:`benchmarks.trace.outside_effects`) move the beam, the rope and the sheet of
``benchmarks.trace.power`` by 3 and by 10 times the noise. The best word for each is no name: ``unexplained``, or where
the numbers that are calibrated anyway absorb it, ``nothing_to_explain``. Every name is counted as forced; of a rolling
shutter a fault of the data is the right kind. ``--resume DIR`` keeps every trace as a line of ``results.jsonl``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.harness import Report, write_section
from benchmarks.trace.outside_effects import OUTSIDE, among_the_known
from benchmarks.trace.power import commit, stored, traced
from benchmarks.trace.power_effects import inject
from benchmarks.trace.power_objects import OBJECTS, observed, recorded
from benchmarks.trace.power_report import CLAIMS, interval

BODIES, LEVELS = ("rope", "beam", "sheet"), (3.0, 10.0)
_NOISE_SEED = 5000


def keys() -> list[str]:
    """All traces in their order: body/effect/level."""
    return [f"{body}/{kind.name}/{level:g}" for level in LEVELS for body in BODIES for kind in OUTSIDE]


def run(key: str) -> dict[str, Any]:
    """One line: what was injected, and what the trace said, which does not know it."""
    body, name, level = key.split("/")
    known = OBJECTS[body](0)
    without = observed(known.truth, known.scene)
    with among_the_known():
        made = inject(name, known, without, float(level))
    line = {"key": key, "object": body, "effect": name, "level": float(level)}
    if made is None:
        return line | {"outcome": "refused", "reason": "no strength within the bounds can be simulated"}
    seed = _NOISE_SEED + [kind.name for kind in OUTSIDE].index(name)
    line |= {"size": made.size, "unit": made.unit, "displacement": made.displacement}
    return line | traced(known, recorded(known.scene, made.tracks, seed))


def forced(row: dict[str, Any]) -> bool:
    """Whether something was named that does not act."""
    right_kind = row["effect"] == "rolling_shutter" and row["outcome"] == "data_issue"
    return row["outcome"] in CLAIMS and not right_kind


def page(rows: list[dict[str, Any]]) -> Report:
    """The table of the rows that there are."""
    table = []
    for kind in OUTSIDE:
        for level in LEVELS:
            here = {r["object"]: r for r in rows if r["effect"] == kind.name and r["level"] == level}
            table.append((kind.title, f"{level:g}", *(_words(here.get(body)) for body in BODIES)))
    ran = [r for r in rows if r["outcome"] not in ("refused", "failed")]
    named = sum(forced(r) for r in ran)
    low, high = interval(named, len(ran))
    commits = Counter(f"{r['commit']}{'+' if r['changed'] else ''}" for r in ran)
    notes = (
        f"Named although the library lacks it: {named} of {len(ran)} (95 % interval {low:.0%} to {high:.0%}, "
        "Clopper-Pearson; **bold**).",
        "Level: displacement over the noise, as above. In brackets: misfit over the noise, before and, where something "
        "is named, after.",
        f"Commits of the method: {', '.join(f'{name} {count}' for name, count in commits.most_common())}; "
        f"{sum(r['cpu_s'] for r in ran) / 60:.0f} minutes of one core.",
    )
    return Report(
        name="trace_outside", title="Something that the library lacks",
        figures={"rows": rows, "forced": named, "ran": len(ran), "ci95": [low, high]},
        header=("what acts", "level", *BODIES), rows=tuple(table), notes=notes, seed=0,
    )  # fmt: skip


def _words(row: dict[str, Any] | None) -> str:
    if row is None:
        return "not run"
    if row["outcome"] in ("refused", "failed"):
        return str(row["outcome"])
    figures = f"{row['misfit_before']:.1f}"
    if row["outcome"] not in CLAIMS:
        return f"{row['outcome'].replace('_', ' ')} ({figures})"
    names = " + ".join(row["names"]) + "".join(f" or {name}" for name in row["equivalent"])
    words = f"{row['outcome'].replace('_', ' ')}: {names} ({figures} to {row['misfit_after']:.1f})"
    return f"**{words}**" if forced(row) else words


def main() -> int:
    """Run what is missing, then write what there is."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trace.outside", description=__doc__)
    parser.add_argument("--json", type=Path, required=True, help="all figures")
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    parser.add_argument("--resume", type=Path, required=True, help="folder that keeps every trace")
    parser.add_argument("--only", nargs="*", default=[], help="bodies, effects or keys; none given: all")
    given = parser.parse_args()
    import warp as wp

    wp.config.quiet = True
    given.resume.mkdir(parents=True, exist_ok=True)
    lines, method = stored(given.resume), commit()
    for key in keys():
        if key in lines or (given.only and not {key, *key.split("/")} & set(given.only)):
            continue
        lines[key] = json.loads(json.dumps(run(key) | method, default=float))
        with (given.resume / "results.jsonl").open("a") as file:
            file.write(json.dumps(lines[key]) + "\n")
        print(json.dumps(lines[key]), flush=True)
    report = page([lines[key] for key in keys() if key in lines])
    given.json.write_text(json.dumps({**report.figures, "machine": report.machine}, indent=2) + "\n")
    if given.docs is not None:
        write_section(report, given.docs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
