"""What a file costs the service: the real web process and the kernel's account of it."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import httpx
import psutil

from benchmarks.service.hostile_files.corpus import Corpus, Hostile
from benchmarks.service.hostile_files.ledger import Cost, Ledger
from benchmarks.service.hostile_files.traces import Traces
from benchmarks.service.web_process import WebProcess, serving
from physworld_services.api.parser_process import limits_of

ANSWER_WITHIN_S = 120.0
CLEAR_PEAK = "5"  # into /proc/PID/clear_refs: the peak of resident memory begins anew


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
        cpu_s = max(0.0, self._cpu_s() - before)
        reader = self.reader_peak(status, len(content))
        return Cost(status, cpu_s, max(self._peak_bytes(), reader), wall_s)

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
            with suppress(OSError):  # it has ended
                Path(f"/proc/{process.pid}/clear_refs").write_text(CLEAR_PEAK)
        self._read = self._log.stat().st_size

    def _peak_bytes(self) -> int:
        """The most resident memory of one process."""
        peaks = [0]
        for process in self._processes():
            with suppress(OSError):  # it has ended
                for line in Path(f"/proc/{process.pid}/status").read_text().splitlines():
                    if line.startswith("VmHWM:"):
                        peaks.append(int(line.split()[1]) * 1024)
        return max(peaks)

    def reader_peak(self, status: int, size: int) -> int:
        """The most resident memory of the child that read a file of ``size`` bytes, which has ended, in bytes.

        The parser process takes it from the kernel (``wait4``) and the web process logs it, also of a child that was
        killed. Where that line is missing because the parser process died, the web process failed (5xx) or did not
        answer (``status`` 0), the child counts with all that it was allowed. An answer below 500 without the line
        means that no child was asked: the request was refused before.
        """
        with self._log.open("rb") as log:
            log.seek(self._read)
            lines = log.read().splitlines()
        told = [json.loads(line) for line in lines if b'"upload_read"' in line]
        lost = any(b'"parser_gone"' in line for line in lines)
        failed = not told and not 0 < status < 500
        allowed = limits_of(size).memory_bytes if lost or failed else 0
        return max([allowed, *(int(line["peak_bytes"]) for line in told)])


def run(
    count: int, seed: int, folder: Path, bundle: bytes, first: int = 0, ledger: Ledger | None = None
) -> dict[str, Any]:
    """Send the known bombs, then the files ``first`` to ``first + count`` of a seed's corpus; the ledger as JSON.

    Args:
        folder: empty; gets the service's data folder, its temporary directory and room for traces.
        ledger: filled as the files are answered, so that the caller has it also where the run breaks off.
    """
    places = {name: folder / name for name in ("traces", "data", "temporary")}
    for place in places.values():
        place.mkdir()
    corpus, ledger = Corpus(places["traces"], bundle, seed), ledger or Ledger(seed, count)
    traces = Traces(places["data"])
    try:
        with (
            serving(places["data"], {"TMPDIR": str(places["temporary"])}) as web,
            closing(Meter(web)) as meter,
        ):
            sound = meter.send("sound.zip", bundle)
            if sound.status != 201:
                raise RuntimeError(f"a sound file was answered {sound.status}")
            for number, hostile in _files(corpus, first, count):
                cost = meter.send(hostile.filename, hostile.content)
                ledger.add(number, hostile.family, len(hostile.content), cost)
                if ledger.count % 500 == 0:
                    print(f"{ledger.count} files, {dict(ledger.statuses)}", file=sys.stderr, flush=True)
    finally:
        ledger.outside = traces.since()
    return ledger.report()


def _files(corpus: Corpus, first: int, count: int) -> Iterator[tuple[int | None, Hostile]]:
    for bomb in corpus.known():
        yield None, bomb
    for number in range(first, first + count):
        yield number, corpus.file(number)
