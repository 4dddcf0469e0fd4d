"""The data factory through the real embedded service: episodes a minute with one and two workers, and 500 of them.

Broker, database, dispatcher and worker processes are those of ``physworld up`` on an empty data folder; the
sample scene is fitted once. Rounds alternate between one and two workers. The service is restarted in
between, and each worker is warmed up by episodes that do not count. The clock runs from the request for the
dataset to the end of its last episode. At last two workers make the target's dataset, 500 episodes of 100 frames, of
a longer beam whose lattice has the target's number of particles (the sample's would have 1512 or 2816), and its
episodes are read again as a training reads them.

A worker's shard reports its seconds of planning and simulating and its seconds of writing to the store; what
is left of the wall time is the queue's: publishing, claiming, committing, waiting for the next shard.
"""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from physworld_client import Client

from benchmarks.harness import Report, interleave, run_alone, summarise
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_storage.episodes import EpisodeStore
from physworld_storage.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
SCENE = ROOT / "sample" / "soft_beam"
MAKE_SCENE = ROOT / "scripts" / "make_sample_scene.py"
SAMPLE_CELLS, LONG_CELLS = 24, (32, 4, 4)  # along x; along x, y, z
PARTICLES, LONG_PARTICLES = 2100, 2400  # asked for: lattices of 2816 and 2016
FRAMES = 100
EPISODES = 24
FULL = 500
TARGET_MINUTES = 10.0
READ_AGAIN = 50
WARM_UP = 2  # episodes a worker
FIT_SIMULATIONS = 12
MOST_ROUNDS = 3  # a round takes a minute
START_S, STOP_S, JOB_S = 120.0, 60.0, 3600.0


class ServiceDidNotStart(RuntimeError):
    """The embedded service ended, or was not ready in time."""


@dataclass(frozen=True)
class Run:
    """One dataset, all times in seconds.

    Attributes:
        workers, episodes: how many.
        particles: of an episode.
        wall_s: from the request to the end of the last episode.
        sealed_s: from the request until the dataset is sealed, its card drawn.
        rejected: tries that were rejected.
        simulate_s, store_s: summed over the episodes, as their workers measured it.
    """

    workers: int
    episodes: int
    particles: int
    wall_s: float
    sealed_s: float
    rejected: int
    simulate_s: float
    store_s: float

    @property
    def per_minute(self) -> float:
        """Episodes a minute."""
        return 60.0 * self.episodes / self.wall_s

    @property
    def store_percent(self) -> float:
        """Writing, in percent of the simulation time."""
        return 100.0 * self.store_s / self.simulate_s

    @property
    def queue_percent(self) -> float:
        """What workers did besides simulating and writing, idling included, in percent of the simulation."""
        return 100.0 * (self.workers * self.wall_s - self.simulate_s - self.store_s) / self.simulate_s


def measure(repeats: int, seed: int) -> Report:
    """Alternate one and two workers, at most ``MOST_ROUNDS`` rounds."""
    runs: dict[int, list[Run]] = {1: [], 2: []}
    with tempfile.TemporaryDirectory(prefix="physworld-bench-") as folder:
        data = Path(folder)
        with service(data, 2) as client:
            fit_id = _fit(client, SCENE, PARTICLES)
            long_fit_id = _fit(client, _long_beam(data / "long_beam"), LONG_PARTICLES)

        def case(workers: int) -> float:
            with service(data, workers) as client:
                _dataset(client, fit_id, WARM_UP * workers, seed)
                runs[workers].append(_timed(client, data, fit_id, workers, EPISODES, seed))
            return runs[workers][-1].per_minute

        rounds = min(repeats, MOST_ROUNDS)
        timings = interleave({"1": lambda: case(1), "2": lambda: case(2)}, rounds)
        with service(data, 2) as client:
            _dataset(client, long_fit_id, 2 * WARM_UP, seed)
            full = _timed(client, data, long_fit_id, 2, FULL, seed)
        read_s = _read_seconds(data)
    speedup = timings["2"].median / timings["1"].median
    figures = {
        "episodes": EPISODES,
        "particles": runs[1][0].particles,
        "frames": FRAMES,
        "episodes_per_minute": {name: timing.median for name, timing in timings.items()},
        "spread": {name: timing.spread for name, timing in timings.items()},
        "speedup_two_workers": speedup,
        "simulate_s_per_episode": {str(n): _median(runs[n], "simulate_s") / EPISODES for n in runs},
        "store_percent": {str(n): _median(runs[n], "store_percent") for n in runs},
        "queue_percent": {str(n): _median(runs[n], "queue_percent") for n in runs},
        "full": {
            "episodes": FULL,
            "particles": full.particles,
            "minutes": full.wall_s / 60.0,
            "minutes_to_seal": full.sealed_s / 60.0,
            "minutes_target": TARGET_MINUTES,
            "simulate_s_per_episode": full.simulate_s / FULL,
            "store_percent": full.store_percent,
            "queue_percent": full.queue_percent,
            "store_and_queue_percent": full.store_percent + full.queue_percent,
            "rejected_tries": full.rejected,
        },
        "read_s_per_episode": read_s,
    }
    rows = [
        [
            name,
            f"{timing.median:.1f} ± {timing.spread:.1f}",
            f"{_median(runs[int(name)], 'simulate_s') / EPISODES:.2f}",
            f"{_median(runs[int(name)], 'store_percent'):.1f} %",
            f"{_median(runs[int(name)], 'queue_percent'):.1f} %",
        ]
        for name, timing in timings.items()
    ]
    rows.append(
        [
            f"2, {FULL} episodes",
            f"{full.per_minute:.1f}",
            f"{full.simulate_s / FULL:.2f}",
            f"{full.store_percent:.1f} %",
            f"{full.queue_percent:.1f} %",
        ]
    )
    return Report(
        name="factory",
        title="Data factory, episodes a minute through the embedded service",
        figures=figures,
        header=["workers", "episodes/min", "simulation, s an episode", "store adds", "queue adds"],
        rows=rows,
        notes=[
            f"Two workers against one: {speedup:.2f} times the episodes a minute.",
            f"{FULL} episodes of {FRAMES} frames at {full.particles} particles: {full.wall_s / 60.0:.1f} min by two "
            f"workers (target: at most {TARGET_MINUTES:.0f} min at 2000 particles), sealed with its card after "
            f"{full.sealed_s / 60.0:.1f} min; rejected and replaced tries: {full.rejected}. They are of the "
            f"sample's beam at {LONG_CELLS[0] / SAMPLE_CELLS:.2f} times its length.",
            f"The other rows: {EPISODES} episodes of the sample scene `{SCENE.name}`, {runs[1][0].particles} "
            f"particles, {rounds} rounds.",
            f"Reading them again for a training takes {1e3 * read_s:.0f} ms an episode, digest checked, once a "
            "training: the tracks stay in memory.",
            "What store and queue add is in percent of the simulation time; with two workers the queue's "
            "share holds the idle end of whoever finishes first, which counts little among 500.",
        ],
        seed=seed,
    )


def _long_beam(folder: Path) -> Path:
    """The sample's beam, longer, made as the sample was."""
    cells = [str(cells) for cells in LONG_CELLS]
    subprocess.run([sys.executable, str(MAKE_SCENE), "--target", str(folder), "--cells", *cells], check=True)
    return folder


def _fit(client: Client, bundle: Path, particles: int) -> str:
    """The id of a fit of a scene bundle."""
    scene = client.scenes.create(bundle)
    config = FitConfig(max_simulations=FIT_SIMULATIONS, particle_budget=particles)
    job = client.jobs.wait(client.fits.create(scene.id, config), timeout=JOB_S)
    fitted: str = job.outputs[0].id
    return fitted


@contextmanager
def service(
    data: Path, workers: int, *, trainer: bool = False, environment: Mapping[str, str] | None = None
) -> Iterator[Client]:
    """The embedded service on ``data`` with so many workers, without a trainer unless asked for; stopped at the end.

    ``environment`` is added to this process's own.
    """
    command = [
        sys.executable,
        "-m",
        "physworld_services.embedded",
        "--data",
        str(data),
        "--workers",
        str(workers),
    ]
    with (data / "service.log").open("a") as log:
        process = subprocess.Popen(
            [*command, *([] if trainer else ["--no-trainer"])],
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **(environment or {})},
        )
        try:
            state = _ready_state(data, process)
            key = Path(state["api_key_file"]).read_text().strip()
            with Client(state["api_url"], key) as client:
                yield client
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _ready_state(data: Path, process: subprocess.Popen[bytes]) -> dict[str, str]:
    """What the service wrote of itself once it is ready."""
    deadline = time.monotonic() + START_S
    path = data / "run" / "state.json"
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise ServiceDidNotStart(f"exit code {process.returncode}: {_tail(data)}")
        if path.exists():
            state: dict[str, str] = json.loads(path.read_text())
            if state.get("pid") == process.pid and state.get("ready"):
                return state
        time.sleep(0.05)
    raise ServiceDidNotStart(f"not ready after {START_S:.0f} s: {_tail(data)}")


def _tail(data: Path) -> str:
    return (data / "service.log").read_text()[-2000:]


def _dataset(client: Client, fit_id: str, episodes: int, seed: int) -> str:
    """Make a dataset and wait for its seal; its job's id."""
    job = client.datasets.create(fit_id, DatasetConfig(episodes=episodes, frames=FRAMES, seed=seed))
    return client.jobs.wait(job, timeout=JOB_S).id


def _timed(client: Client, data: Path, fit_id: str, workers: int, episodes: int, seed: int) -> Run:
    """A dataset of so many episodes and what its shards reported."""
    asked = datetime.now(UTC)
    job_id = _dataset(client, fit_id, episodes, seed)
    sealed = datetime.now(UTC)
    with _reading(data) as database:
        rows = database.execute(
            "SELECT result, finished_at FROM shards WHERE job_id = ? AND kind = 'episode'", (job_id,)
        ).fetchall()
    results = [json.loads(result) for result, _ in rows]
    last = max(datetime.fromisoformat(finished) for _, finished in rows)
    return Run(
        workers=workers,
        episodes=len(rows),
        particles=results[0]["particles"],
        wall_s=(last.replace(tzinfo=UTC) - asked).total_seconds(),
        sealed_s=(sealed - asked).total_seconds(),
        rejected=sum(len(result["rejected"]) for result in results),
        simulate_s=sum(result["seconds"] for result in results),
        store_s=sum(result["store_seconds"] for result in results),
    )


def _read_seconds(data: Path) -> float:
    """Seconds to read an episode of the newest dataset and check its digest, the median of a few."""
    with _reading(data) as database:
        newest = database.execute("SELECT id FROM datasets ORDER BY created_at DESC LIMIT 1").fetchone()[0]
        rows = database.execute(
            "SELECT path, digest FROM episodes WHERE dataset_id = ? LIMIT ?", (newest, READ_AGAIN)
        ).fetchall()
    store = EpisodeStore(Settings(data_dir=data))
    seconds = []
    for path, digest in rows:
        started = time.perf_counter()
        store.read(path, digest)
        seconds.append(time.perf_counter() - started)
    return summarise(seconds).median


@contextmanager
def _reading(data: Path) -> Iterator[sqlite3.Connection]:
    database = sqlite3.connect(f"file:{data / 'physworld.db'}?mode=ro", uri=True)
    try:
        yield database
    finally:
        database.close()


def _median(runs: list[Run], field: str) -> float:
    return summarise([getattr(run, field) for run in runs]).median


if __name__ == "__main__":
    run_alone(measure)
