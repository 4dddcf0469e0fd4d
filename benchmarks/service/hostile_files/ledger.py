"""The ledger of a run: what each family of hostile files cost at most, which broke a limit, and the table of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from benchmarks.harness import Report, describe_machine

MOST_CPU_S, MOST_BYTES = 5.0, 512 * 2**20
KEPT = 20


@dataclass
class Cost:
    """What the service's processes spent on one file; status 0 stands for no answer."""

    status: int
    cpu_s: float
    peak_bytes: int
    wall_s: float


@dataclass
class Ledger:
    """Everything about a run that is worth keeping.

    Attributes:
        seed: of the corpus.
        asked: how many files of the corpus are to be sent; the known bombs come in addition.
        statuses: how often each status was answered; 0 stands for no answer.
        families: of each family of files, the count and the most that one cost; a known bomb is a family of one file.
        beyond: the files that broke a limit, at most ``KEPT``.
        broken: how many broke one.
        outside: paths that were made, changed or removed where no upload may do so.
    """

    seed: int
    asked: int
    statuses: Counter[int] = field(default_factory=Counter)
    families: dict[str, dict[str, Any]] = field(default_factory=dict)
    beyond: list[dict[str, Any]] = field(default_factory=list)
    broken: int = 0
    outside: list[str] = field(default_factory=list)
    machine: dict[str, Any] = field(default_factory=describe_machine)

    def add(self, number: int | None, family: str, size: int, cost: Cost) -> None:
        """One file's cost; ``number`` is None for a known bomb."""
        self.statuses[cost.status] += 1
        most = self.families.setdefault(
            family, {"files": 0, "most_cpu_s": 0.0, "most_mib": 0.0, "most_wall_s": 0.0, "statuses": {}}
        )
        mib = cost.peak_bytes / 2**20
        most["files"] += 1
        most["statuses"][str(cost.status)] = most["statuses"].get(str(cost.status), 0) + 1
        for name, value in (("most_cpu_s", cost.cpu_s), ("most_mib", mib), ("most_wall_s", cost.wall_s)):
            most[name] = round(max(most[name], value), 2)
        failed = cost.status == 0 or cost.status >= 500
        if failed or cost.cpu_s > MOST_CPU_S or cost.peak_bytes > MOST_BYTES:
            self.broken += 1
            if len(self.beyond) < KEPT:
                self.beyond.append(
                    {"number": number, "family": family, "bytes": size, "status": cost.status,
                     "cpu_s": round(cost.cpu_s, 2), "mib": round(mib, 1)}
                )  # fmt: skip

    @property
    def count(self) -> int:
        """Files sent, known bombs included."""
        return sum(self.statuses.values())

    def report(self) -> dict[str, Any]:
        """The ledger as JSON."""
        return {
            "files": self.count,
            "asked": self.asked,
            "seed": self.seed,
            "statuses": {str(status): count for status, count in sorted(self.statuses.items())},
            "errors_of_the_service": sum(n for status, n in self.statuses.items() if not 0 < status < 500),
            "most_cpu_s": max((most["most_cpu_s"] for most in self.families.values()), default=0.0),
            "most_mib": max((most["most_mib"] for most in self.families.values()), default=0.0),
            "files_beyond": self.broken,
            "beyond": self.beyond,
            "files_outside": self.outside,
            "families": self.families,
            "machine": self.machine,
        }

    def table(self) -> Report:
        """The ledger for people."""
        rows = [
            [
                family,
                str(most["files"]),
                f"{most['most_cpu_s']:.2f}",
                f"{most['most_mib']:.0f}",
                ", ".join(f"{status}: {count}" for status, count in sorted(most["statuses"].items())),
            ]
            for family, most in self.families.items()
        ]
        whole = self.report()
        return Report(
            "hostile_files",
            "Hostile files",
            whole,
            ["family", "files", "most processor time, s", "most memory of one process, MiB", "answers"],
            rows,
            [
                f"{self.count} files: the known bombs at full size, one a row, then {self.asked} from the seed. Each "
                "was uploaded over HTTP to the real web process on SQLite and a local folder; time and memory are the "
                "kernel's account of the web process, its parser processes and their children.",
                f"Over {MOST_CPU_S:g} s or {MOST_BYTES // 2**20} MiB, answered 5xx or not answered: {self.broken}. "
                "Made, changed or removed outside the data folder (beside it, in the temporary directory, in the "
                f"working directory): {len(self.outside)}.",
                f"Command: `python -m benchmarks.service.hostile_files --count {self.asked} --seed {self.seed}`.",
            ],
            self.seed,
            self.machine,
        )
