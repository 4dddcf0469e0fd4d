"""``python -m benchmarks.service.api_load``: how fast a job is answered beside a long queue and many followers.

The real web process on SQLite; ``CONNECTIONS`` keep-alive connections ask ``GET /v1/jobs/{id}`` one after the other,
for a job with so many shards to do, with and without followers of its events, of which one comes every ``EVENT_S``.
The client is a bare socket for each connection, so that it takes little of the machine that it shares with the service.
``--json FILE`` writes the figures; the table goes into ``docs/benchmarks.md`` by ``python -m benchmarks api_load``.
"""

from __future__ import annotations

import asyncio
import re
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Report, run_alone
from benchmarks.service.hostile_files.corpus import sound_bundle
from benchmarks.service.web_process import WebProcess, serving
from physworld_storage.database import Database, open_database
from physworld_storage.jobs import events, shards
from physworld_storage.settings import Settings
from physworld_storage.tables import JobRow

CONNECTIONS, FOLLOWERS = 16, 50
QUEUED = (0, 10_000, 100_000)
SECONDS, WARM_S, EVENT_S = 4.0, 1.0, 0.1


def measure(repeats: int, seed: int) -> Report:
    """Requests a second and latencies of every case, the median over ``repeats`` rounds."""
    cases = [(queued, followers) for followers in (0, FOLLOWERS) for queued in QUEUED]
    found: dict[tuple[int, int], list[tuple[float, float, float]]] = {case: [] for case in cases}
    with tempfile.TemporaryDirectory() as folder, serving(Path(folder)) as web:
        database = open_database(Settings(data_dir=Path(folder)))
        jobs = {queued: _job(web, database, queued) for queued in QUEUED}
        for _ in range(repeats):
            for queued, followers in cases:
                found[queued, followers].append(_case(web, database, jobs[queued], followers))
        database.dispose()
    medians = {case: np.median(rounds, axis=0) for case, rounds in found.items()}
    figures: dict[str, Any] = {
        f"{queued}_queued_{followers}_followers": {
            "requests_per_s": float(rate), "p50_ms": float(p50), "p99_ms": float(p99),
            "ratio_to_idle": float(rate / medians[0, 0][0]),
        }
        for (queued, followers), (rate, p50, p99) in medians.items()
    }  # fmt: skip
    return Report(
        name="api_load",
        title="GET of a job at 16 connections",
        figures=figures,
        header=("queued shards", "followers", "requests/s", "of the idle service's", "p50", "p99"),
        rows=[
            (
                f"{queued:,}", str(followers), f"{rate:.0f}", f"{rate / medians[0, 0][0]:.2f}",
                f"{p50:.1f} ms", f"{p99:.1f} ms",
            )
            for (queued, followers), (rate, p50, p99) in medians.items()
        ],
        notes=(
            f"One web process on SQLite; the client runs on the same machine. Followers hear an event every "
            f"{EVENT_S:g} s. Median of {repeats} rounds of {SECONDS:g} s.",
        ),
        seed=seed,
    )  # fmt: skip


def _job(web: WebProcess, database: Database, queued: int) -> str:
    """A job whose stage has so many shards to do."""
    with web.client() as client:
        scene = client.post("/v1/scenes", files={"bundle": ("scene.zip", sound_bundle())}).json()["id"]
        job_id = str(client.post("/v1/fits", json={"scene_id": scene}).json()["id"])
    with database.session() as session:
        job = session.get_one(JobRow, job_id)
        job.stage += 1
        shards.put_up(session, job, shards.Stage("episode", {"dataset_id": "none"}, queued or None))
    return job_id


def _case(web: WebProcess, database: Database, job_id: str, followers: int) -> tuple[float, float, float]:
    """Requests a second, and the 50th and 99th percentile of their latencies [ms]."""
    ended = threading.Event()
    telling = threading.Thread(target=_tell, args=(database, job_id, ended), daemon=True)
    telling.start()
    try:
        latencies = asyncio.run(_load(web, job_id, followers))
    finally:
        ended.set()
        telling.join()
    p50, p99 = np.percentile(latencies, [50, 99]) * 1000
    return len(latencies) / SECONDS, float(p50), float(p99)


def _tell(database: Database, job_id: str, ended: threading.Event) -> None:
    done = 0
    while not ended.wait(EVENT_S):
        done += 1
        with database.session() as session:
            events.append_event(session, job_id, "progress", {"done": done, "total": 10_000, "unit": "runs"})


async def _load(web: WebProcess, job_id: str, followers: int) -> list[float]:
    """Latencies of all requests within ``SECONDS`` [s]."""
    port = int(web.url.rpartition(":")[2])
    following = [
        asyncio.create_task(_follow(port, _request(f"/v1/jobs/{job_id}/events", web.token)))
        for _ in range(followers)
    ]
    await asyncio.sleep(WARM_S)
    request, until = _request(f"/v1/jobs/{job_id}", web.token), time.perf_counter() + SECONDS
    asked = await asyncio.gather(*(_ask(port, request, until) for _ in range(CONNECTIONS)))
    for task in following:
        if task.done():
            task.result()
        task.cancel()
    await asyncio.gather(*following, return_exceptions=True)
    return [latency for latencies in asked for latency in latencies]


def _request(path: str, token: str) -> bytes:
    return f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {token}\r\n\r\n".encode()


async def _ask(port: int, request: bytes, until: float) -> list[float]:
    """One connection's requests, one after the other. Raises RuntimeError at an answer that is not 200."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    latencies = []
    while (started := time.perf_counter()) < until:
        writer.write(request)
        head = await reader.readuntil(b"\r\n\r\n")
        length = re.search(rb"content-length: (\d+)", head, re.IGNORECASE)
        if not head.startswith(b"HTTP/1.1 200") or length is None:
            raise RuntimeError(head.decode())
        await reader.readexactly(int(length[1]))
        latencies.append(time.perf_counter() - started)
    writer.close()
    return latencies


async def _follow(port: int, request: bytes) -> None:
    """Read events until cancelled. Raises RuntimeError where the stream is refused or ends."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(request)
        head = await reader.readuntil(b"\r\n\r\n")
        while head.startswith(b"HTTP/1.1 200") and await reader.read(65536):
            pass
        raise RuntimeError(f"a stream of events ended: {head.decode()}")
    finally:
        writer.close()


if __name__ == "__main__":
    run_alone(measure)
