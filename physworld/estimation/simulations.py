"""Simulations that do not depend on each other, run wherever there is room: in this process, in others, or by workers.

A job says what to simulate; a *runner* maps jobs to tracks. The same jobs give the same tracks under every runner.
:class:`Simulations` counts the runs of an inference, reports them, ends them when they are cancelled or time is up, and
remembers them under the job's fingerprint: an inference that was cut off and starts again with the same memory goes on
where it was.
"""

from __future__ import annotations

import hashlib
import json
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Protocol

import numpy as np

from physworld.arrays import Array
from physworld.engine.formulations import TOTAL
from physworld.errors import Cancelled, CFLViolation, SimulationError, WorkerLost
from physworld.twin.twin import Twin

_ENGINE = (
    "effects",
    "engine",
    "geometry",
    "materials",
    "shapes",
    "twin",
)  # and the modules of ``physworld`` itself


@dataclass(frozen=True)
class Job:
    """One simulation.

    Attributes:
        twin: what moves.
        frames: from the first frame to before this one.
        step_share: time step over the stable one.
        least_step_s: a twin that gets less far by one evaluation of its forces is not run.
    """

    twin: Twin
    frames: int
    step_share: float = 1.0
    least_step_s: float = 0.0

    def fingerprint(self, drive: bytes) -> str:
        """Digest of everything that the result depends on; ``drive`` stands for times and controls.

        Also on the engine: a memory that is kept over a change of it starts afresh.
        """
        digest = hashlib.sha256(drive + engine().encode())
        arrays = self.twin.to_arrays()
        for name in sorted(arrays):
            value = np.ascontiguousarray(arrays[name])
            digest.update(f"{name} {value.dtype} {value.shape}".encode())
            digest.update(value.tobytes())
        digest.update(json.dumps([self.frames, self.step_share]).encode())
        return digest.hexdigest()


@cache
def engine() -> str:
    """Digest of the sources that decide what a simulation gives; read once in a process."""
    home = Path(__file__).parents[1]
    sources = [*home.glob("*.py"), *(source for room in _ENGINE for source in (home / room).rglob("*.py"))]
    digest = hashlib.sha256()
    for source in sorted(sources):
        content = source.read_bytes()
        digest.update(f"{source.relative_to(home).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()


@dataclass(frozen=True)
class Drive:
    """What drives every simulation of a scene: control track (Tc,), (Tc, K, 3) and frame times (T,)."""

    control_times: Array
    control_points: Array
    times: Array

    def digest(self) -> bytes:
        """Fingerprint."""
        digest = hashlib.sha256()
        for value in (self.control_times, self.control_points, self.times):
            digest.update(np.ascontiguousarray(value, dtype=float).tobytes())
        return digest.digest()


def nodes_of(job: Job, drive: Drive, poll: Callable[[int, int], None] | None = None) -> Array:
    """Carriers (frames, n, 3) [m] of a job. Raises SimulationError."""
    twin = job.twin
    run = twin.integration(drive.control_times, drive.control_points, drive.times[: job.frames])
    solver = twin.solver(run.problem)
    if not twin.form.on_particles and solver.stage_s < job.least_step_s:
        raise CFLViolation(
            f"{solver.stage_s:.3g} s for an evaluation of the forces is below {job.least_step_s:.3g} s, which a "
            "trace waits for"
        )
    if job.step_share != 1.0:
        solver = twin.solver(run.problem, job.step_share * solver.time_step_s)
    return twin.carriers(solver, run, poll)


def stage_s(twin: Twin, drive: Drive) -> float:
    """How far one evaluation of its forces brings a twin [s]: its stable time step, or a stage of its friction."""
    run = twin.integration(drive.control_times, drive.control_points, drive.times[:2])
    form = TOTAL if twin.form.on_particles else twin.form
    return float(form.solver(run.problem).stage_s)


def tracks_of(job: Job, drive: Drive, poll: Callable[[int, int], None] | None = None) -> Array | None:
    """Observed points (frames, N, 3) [m] of a job; None where the run cannot be trusted."""
    try:
        nodes = nodes_of(job, drive, poll)
    except SimulationError:
        return None
    tracks = job.twin.observe(nodes, drive.times[: job.frames])
    # in one order in memory wherever it was run, for sums depend on it in their last digits
    return np.ascontiguousarray(tracks) if np.isfinite(tracks).all() else None


class Runner(Protocol):
    """Yields the tracks of jobs in their order; None for a run that cannot be trusted. ``poll`` may raise to stop."""

    def __call__(
        self, jobs: Sequence[Job], drive: Drive, poll: Callable[[], None]
    ) -> Iterator[Array | None]: ...


def in_turn(jobs: Sequence[Job], drive: Drive, poll: Callable[[], None]) -> Iterator[Array | None]:
    """The runner of this process."""
    for job in jobs:
        yield tracks_of(job, drive, lambda done, total: poll())


def idle_beside(runner: Runner, jobs: int) -> int:
    """Processes of a runner that wait while the last of so many simulations run; 0 where it does not say how many."""
    return -jobs % int(getattr(runner, "processes", 1))


class Workers:
    """A runner over processes of its own, which share Warp's cache of kernels; a context manager.

    Attributes:
        processes: how many.
    """

    def __init__(self, processes: int = 2) -> None:
        self.processes = processes
        self._pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_begin)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *failure: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __call__(self, jobs: Sequence[Job], drive: Drive, poll: Callable[[], None]) -> Iterator[Array | None]:
        """Every job in a process; ``poll`` is called before each is waited for. Where it raises, jobs that have not
        begun never do.

        Raises:
            WorkerLost: a process ended, by the system's hand or another's.
        """
        futures: list[Future[Array | None]] = []
        try:
            for job in jobs:
                facts = (job.twin.to_arrays(), job.twin.device, _facts(job), drive)
                futures.append(self._pool.submit(_work, *facts))
            for future in futures:
                poll()
                yield future.result()
        except BrokenProcessPool as error:
            raise WorkerLost(
                f"one of {self.processes} processes that share the simulations ended ({len(jobs)} were asked for): "
                "was it out of memory?"
            ) from error
        finally:
            for future in futures:
                future.cancel()


def _begin() -> None:
    """A process of the pool says nothing, and leaves Ctrl-C to the process that waits for it."""
    import warp as wp

    wp.config.quiet = True
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _facts(job: Job) -> tuple[int, float, float]:
    return job.frames, job.step_share, job.least_step_s


def _work(
    arrays: dict[str, Array], device: str, facts: tuple[int, float, float], drive: Drive
) -> Array | None:
    return tracks_of(Job(Twin.from_arrays(arrays, device), *facts), drive)


Progress = Callable[[int, int, str], None]


class Memory:
    """Tracks by fingerprint, in a folder if one is given."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._known: dict[str, Array | None] = {}
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def get(self, key: str) -> tuple[bool, Array | None]:
        """Whether the run is known, and its tracks."""
        if key in self._known:
            return True, self._known[key]
        if self._folder is None or not (self._folder / f"{key}.npy").exists():
            return False, None
        try:
            tracks = np.load(self._folder / f"{key}.npy", allow_pickle=False)
        except (OSError, ValueError, EOFError):  # cut off while it was written
            return False, None
        return True, tracks if tracks.size else None

    def put(self, key: str, tracks: Array | None) -> None:
        """Remember a run; one that failed as an empty array."""
        if self._folder is None:
            self._known[key] = tracks
            return
        part = self._folder / f"{key}.part.npy"
        np.save(part, np.empty(0) if tracks is None else tracks, allow_pickle=False)
        part.replace(self._folder / f"{key}.npy")


class TimeUp(Exception):
    """The time for what is being searched is up; raised by a run, caught by :meth:`Simulations.time_permitting`."""


@dataclass
class Ledger:
    """What the stages of a trace have cost, and until when it searches.

    Attributes:
        spent: runs that were not remembered and their seconds, by stage.
        ends_at: by ``time.perf_counter``.
        cut: searches that ended before they were through, or did not begin.
    """

    spent: dict[str, tuple[int, float]] = field(default_factory=dict)
    ends_at: float = float("inf")
    cut: list[str] = field(default_factory=list)

    def add(self, stage: str, runs: int, seconds: float) -> None:
        """Add to what a stage has cost."""
        before = self.spent.get(stage, (0, 0.0))
        self.spent[stage] = (before[0] + runs, before[1] + seconds)


class Simulations:
    """Counts, remembers, reports and stops.

    Attributes:
        count: runs asked for, those remembered included.
        stage: what they are for.
        least_step_s: a twin that needs a smaller time step is not run.
        ledger: what stages cost, and until when they may go on.

    Args:
        drive: controllers and frame times of the scene.
        runner: runs jobs, here or in other processes.
        memory: tracks of earlier runs; None begins an empty one.
        progress: called with (done, in all, stage).
        cancelled: polled during simulations.
    """

    def __init__(
        self,
        drive: Drive,
        runner: Runner = in_turn,
        memory: Memory | None = None,
        progress: Progress | None = None,
        cancelled: Callable[[], bool] | None = None,
    ) -> None:
        self.drive, self.count = drive, 0
        self._runner, self._memory = runner, memory or Memory()
        self._progress, self._cancelled = progress, cancelled
        self.stage, self.least_step_s, self.ledger = "", 0.0, Ledger()

    @contextmanager
    def time_permitting(self, stage: str) -> Iterator[None]:
        """A search that is left where time is up, and then is in ``ledger.cut``; ``stage``: what it is for."""
        self.stage = stage
        try:
            yield
        except TimeUp:
            self.ledger.cut.append(stage)

    def run(self, jobs: Sequence[Job]) -> list[Array | None]:
        """Tracks of every job. Raises Cancelled, TimeUp."""
        return self.under(self.drive, jobs)

    def under(self, drive: Drive, jobs: Sequence[Job]) -> list[Array | None]:
        """Tracks of every job under this drive. Raises Cancelled, TimeUp."""
        digest = drive.digest()
        keys = [job.fingerprint(digest) for job in jobs]
        known = [self._memory.get(key) for key in keys]
        missing = [k for k, (found, _) in enumerate(known) if not found]
        tracks = [found for _, found in known]
        self.count += len(jobs) - len(missing)
        waiting = [replace(jobs[k], least_step_s=self.least_step_s) for k in missing]
        if missing:
            self._poll()
        fresh = self._runner(waiting, drive, self._poll) if missing else iter(())
        for k, made in zip(missing, self._timed(fresh), strict=True):
            self._memory.put(keys[k], made)
            tracks[k] = made
            self.count += 1
            if self._progress is not None:
                self._progress(self.count, 0, self.stage)
        return tracks

    def _timed(self, fresh: Iterator[Array | None]) -> Iterator[Array | None]:
        """The same, with its seconds in the ledger."""
        begun = time.perf_counter()
        for made in fresh:
            now = time.perf_counter()
            self.ledger.add(self.stage, 1, now - begun)
            yield made
            begun = time.perf_counter()

    def elsewhere(self, drive: Drive) -> Simulations:
        """Simulations under another drive, with the same runner, memory and watchers; their count goes on from here."""
        other = Simulations(drive, self._runner, self._memory, self._progress, self._cancelled)
        other.count, other.stage, other.least_step_s = self.count, self.stage, self.least_step_s
        other.ledger = self.ledger
        return other

    def _poll(self) -> None:
        if time.perf_counter() > self.ledger.ends_at:
            raise TimeUp(f"after {self.count} simulations in the stage {self.stage!r}")
        if self._cancelled is not None and self._cancelled():
            raise Cancelled(f"trace cancelled after {self.count} simulations in the stage {self.stage!r}")
