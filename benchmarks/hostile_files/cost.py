"""What a file costs the service: the real web process, the kernel's account of it, and a ledger."""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import psutil

from benchmarks.harness import describe_machine
from benchmarks.hostile_files.corpus import Corpus
from benchmarks.web_process import WebProcess, serving

MOST_CPU_S, MOST_BYTES = 5.0, 512 * 2**20
ANSWER_WITHIN_S = 120.0
CLEAR_PEAK = "5"  # into /proc/PID/clear_refs: the peak of resident memory begins anew
KEPT = 20


@dataclass
class Cost:
    """What the service's processes spent on one file."""

    status: int
    cpu_s: float
    peak_bytes: int
    wall_s: float


@dataclass
class Ledger:
    """Everything about a run that is worth keeping.

    Attributes:
        statuses: how often each status was answered; 0 stands for no answer.
        families: of each family of files, the count and the most that one cost.
        beyond: the files that broke a limit, at most ``KEPT``.
    """

    statuses: Counter[int] = field(default_factory=Counter)
    families: dict[str, dict[str, float]] = field(default_factory=dict)
    beyond: list[dict[str, Any]] = field(default_factory=list)
    count: int = 0

    def add(self, number: int, family: str, size: int, cost: Cost) -> None:
        """One file's cost."""
        self.count += 1
        self.statuses[cost.status] += 1
        most = self.families.setdefault(
            family, {"files": 0, "most_cpu_s": 0.0, "most_mib": 0.0, "most_wall_s": 0.0}
        )
        mib = cost.peak_bytes / 2**20
        most["files"] += 1
        for name, value in (("most_cpu_s", cost.cpu_s), ("most_mib", mib), ("most_wall_s", cost.wall_s)):
            most[name] = round(max(most[name], value), 2)
        broken = cost.status == 0 or cost.status >= 500
        if (broken or cost.cpu_s > MOST_CPU_S or cost.peak_bytes > MOST_BYTES) and len(self.beyond) < KEPT:
            self.beyond.append(
                {"number": number, "family": family, "bytes": size, "status": cost.status,
                 "cpu_s": round(cost.cpu_s, 2), "mib": round(mib, 1)}
            )  # fmt: skip

    def report(self, seed: int, trespasses: list[str]) -> dict[str, Any]:
        """The ledger as JSON."""
        return {
            "files": self.count,
            "seed": seed,
            "statuses": {str(status): count for status, count in sorted(self.statuses.items())},
            "errors_of_the_service": sum(n for status, n in self.statuses.items() if not 0 < status < 500),
            "most_cpu_s": max((most["most_cpu_s"] for most in self.families.values()), default=0.0),
            "most_mib": max((most["most_mib"] for most in self.families.values()), default=0.0),
            "beyond": self.beyond,
            "files_outside": trespasses,
            "families": self.families,
            "machine": describe_machine(),
        }


class Meter:
    """A web process, and what it and the processes under it have used."""

    def __init__(self, web: WebProcess) -> None:
        self._process, self._log, self._read = psutil.Process(web.pid), web.log, 0
        self._client = web.client(ANSWER_WITHIN_S)

    def close(self) -> None:
        """Let go of the connection."""
        self._client.close()

    def send(self, filename: str, content: bytes) -> Cost:
        """Upload a file and see what it cost."""
        self._forget()
        before, started = self._cpu_s(), time.perf_counter()
        try:
            answer = self._client.post("/v1/scenes", files={"bundle": (filename, content)})
            status = answer.status_code
        except httpx.TransportError:
            status = 0
        wall_s = time.perf_counter() - started
        return Cost(status, self._cpu_s() - before, max(self._peak_bytes(), self._reader_peak()), wall_s)

    def _processes(self) -> list[psutil.Process]:
        return [self._process, *self._process.children(recursive=True)]

    def _cpu_s(self) -> float:
        """Of all processes, those included that have ended and were waited for."""
        total = 0.0
        for process in self._processes():
            try:
                total += sum(process.cpu_times()[:4])
            except psutil.NoSuchProcess:
                continue
        return total

    def _forget(self) -> None:
        for process in self._processes():
            Path(f"/proc/{process.pid}/clear_refs").write_text(CLEAR_PEAK)
        self._read = self._log.stat().st_size

    def _peak_bytes(self) -> int:
        """The most resident memory of one process."""
        peaks = [0]
        for process in self._processes():
            for line in Path(f"/proc/{process.pid}/status").read_text().splitlines():
                if line.startswith("VmHWM:"):
                    peaks.append(int(line.split()[1]) * 1024)
        return max(peaks)

    def _reader_peak(self) -> int:
        """The most resident memory of the child that read the file, which has ended: from the log."""
        with self._log.open("rb") as log:
            log.seek(self._read)
            lines = log.read().splitlines()
        told = [json.loads(line) for line in lines if b'"upload_read"' in line]
        return max((int(line["peak_bytes"]) for line in told), default=0)


def run(count: int, seed: int, folder: Path, bundle: bytes, first: int = 0) -> dict[str, Any]:
    """Send the files ``first`` to ``first + count`` of a seed's corpus; the ledger."""
    (folder / "traces").mkdir()
    (folder / "data").mkdir()
    corpus, ledger = Corpus(folder / "traces", bundle, seed), Ledger()
    earlier = set(corpus.trespasses())
    with serving(folder / "data") as web, closing(Meter(web)) as meter:
        sound = meter.send("sound.zip", bundle)
        if sound.status != 201:
            raise RuntimeError(f"a sound file was answered {sound.status}")
        for number in range(first, first + count):
            hostile = corpus.file(number)
            ledger.add(
                number, hostile.family, len(hostile.content), meter.send(hostile.filename, hostile.content)
            )
            if number % 500 == 499:
                print(f"{number + 1} files, {dict(ledger.statuses)}", file=sys.stderr, flush=True)
    return ledger.report(seed, sorted(set(corpus.trespasses()) - earlier))
