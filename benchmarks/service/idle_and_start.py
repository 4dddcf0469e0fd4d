"""What the embedded service costs while nobody asks for anything, and how long it takes to start.

``python -m benchmarks.service.idle_and_start [--json FILE]``: starts the service on an empty folder (cold), lets it
idle, measures how long a job waits for a worker, and starts it again on the same folder. Wall times of a shared machine
vary with its neighbours, so every start is also given in CPU seconds of the whole family of processes until it is
ready.

PHYSWORLD_DATABASE_URL names a Postgres server to measure on instead of SQLite; its database has to be empty.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from physworld_client import Client

from benchmarks.harness import Report, run_alone, summarise
from physworld_schemas.fit import FitConfig

SCENE = Path(__file__).resolve().parents[2] / "sample" / "soft_beam"
SETTLE_S, IDLE_S = 10.0, 60.0
MOST_RESTARTS = 3
WAITING_JOBS, WARM_UP = 10, 6
START_S, STOP_S, JOB_S = 150.0, 60.0, 120.0


class NotReady(RuntimeError):
    """The service ended, or was not ready in time."""


@dataclass(frozen=True)
class Start:
    """One start: wall seconds until the service says that it is ready, and CPU seconds of all its processes by then."""

    wall_s: float
    cpu_s: float


def measure(repeats: int, seed: int) -> Report:
    """A cold start, a minute of idling, at most ``MOST_RESTARTS`` restarts, and jobs that come to an idle service."""
    with tempfile.TemporaryDirectory(prefix="physworld-idle-") as folder:
        data = Path(folder)
        with _service(data) as (cold, supervisor):
            idle = _idle_percent(supervisor, _names(data))
            waited_s = _waits(data)
        restarts = []
        for _ in range(min(repeats, MOST_RESTARTS)):
            with _service(data) as (start, _):
                restarts.append(start)
    wall, cpu = summarise([s.wall_s for s in restarts]), summarise([s.cpu_s for s in restarts])
    wait = summarise(waited_s)
    figures: dict[str, Any] = {
        "cold": {"ready_s": cold.wall_s, "cpu_s": cold.cpu_s},
        "restart": {"ready_s": wall.median, "cpu_s": cpu.median, "rounds": len(restarts)},
        "idle_percent": idle,
        "idle_percent_sum": sum(idle.values()),
        "idle_seconds": IDLE_S,
        "job_waits_s": {"median": wait.median, "most": max(wait.rounds), "jobs": len(wait.rounds)},
    }
    rows = [
        ["cold start, ready after", f"{cold.wall_s:.1f} s", f"{cold.cpu_s:.1f} CPU s"],
        ["restart, ready after", f"{wall.median:.1f} ± {wall.spread:.1f} s", f"{cpu.median:.1f} CPU s"],
        [
            "a job waits for an idle worker",
            f"{1e3 * wait.median:.0f} ms",
            f"at most {1e3 * max(wait.rounds):.0f} ms",
        ],
        *([f"idle: {name}", f"{percent:.2f} %", "of a core"] for name, percent in sorted(idle.items())),
        ["idle: all of them", f"{sum(idle.values()):.2f} %", "of a core"],
    ]
    return Report(
        name="idle_and_start",
        title="An idle service, and its start",
        figures=figures,
        header=["what", "measured", ""],
        rows=rows,
        notes=[
            f"Idle: {IDLE_S:.0f} s, from {SETTLE_S:.0f} s after the cold start, a process with its children.",
            f"Restart: the median of {len(restarts)} on the folder of the cold start. A job's wait is from its row's "
            f"`created_at` to its `started_at`, {len(waited_s)} jobs one after the other.",
            "The machine is shared: a start's wall seconds vary with its neighbours, its CPU seconds hardly do.",
        ],
        seed=seed,
    )  # fmt: skip


@contextmanager
def _service(data: Path) -> Iterator[tuple[Start, psutil.Process]]:
    """The embedded service as ``physworld up`` starts it, ready; with the supervisor's process."""
    command = [sys.executable, "-m", "physworld_services.embedded", "--data", str(data)]
    with (data / "service.log").open("a") as log:
        started = time.monotonic()
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        try:
            _wait_until_ready(data, process)
            supervisor = psutil.Process(process.pid)
            wall_s = time.monotonic() - started
            yield (
                Start(wall_s, sum(map(_cpu_s, [supervisor, *supervisor.children(recursive=True)]))),
                supervisor,
            )
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _wait_until_ready(data: Path, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise NotReady(f"exit code {process.returncode}: {(data / 'service.log').read_text()[-2000:]}")
        state = _state(data)
        if state.get("pid") == process.pid and state.get("ready"):
            return
        time.sleep(0.02)
    raise NotReady(f"not ready after {START_S:.0f} s: {(data / 'service.log').read_text()[-2000:]}")


def _state(data: Path) -> dict[str, Any]:
    path = data / "run" / "state.json"
    try:
        state: dict[str, Any] = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    return state


def _names(data: Path) -> dict[int, str]:
    """The children's names by process id."""
    return {int(pid): name for name, pid in _state(data)["children"].items()}


def _cpu_s(process: psutil.Process) -> float:
    """CPU seconds of a process and of its children that have ended."""
    times = process.cpu_times()
    return float(times.user + times.system + times.children_user + times.children_system)


def _idle_percent(supervisor: psutil.Process, names: dict[int, str]) -> dict[str, float]:
    """Percent of a core that each child with its own children takes over ``IDLE_S``."""
    time.sleep(SETTLE_S)
    families = {"supervisor": [supervisor]} | {
        name: [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
        for pid, name in names.items()
    }
    before = {name: sum(map(_cpu_s, family)) for name, family in families.items()}
    started = time.monotonic()
    time.sleep(IDLE_S)
    elapsed_s = time.monotonic() - started
    after = {name: sum(map(_cpu_s, family)) for name, family in families.items()}
    return {name: 100.0 * (after[name] - before[name]) / elapsed_s for name in families}


def _waits(data: Path) -> list[float]:
    """Seconds from the creation of a job to its start by an idle worker; both workers are warm by then."""
    state = _state(data)
    config = FitConfig(max_simulations=1, particle_budget=50, numerics=False)
    waited = []
    with Client(state["api_url"], Path(state["api_key_file"]).read_text().strip()) as client:
        scene = client.scenes.create(SCENE)
        for number in range(WAITING_JOBS + WARM_UP):
            given = config.model_copy(update={"particle_budget": 50 + number})
            job = client.jobs.wait(client.fits.create(scene.id, given), timeout=JOB_S)
            if number >= WARM_UP:  # the first one of each worker imports the physics
                assert job.started_at is not None
                waited.append((job.started_at - job.created_at).total_seconds())
    return waited


if __name__ == "__main__":
    run_alone(measure)
