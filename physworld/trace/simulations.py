"""Simulations of a trace: jobs that are independent of each other, counted, remembered, and run wherever there is room.

A job says what to simulate; a *runner* maps jobs to tracks, in this process or in others. What was run is remembered
under the job's fingerprint, so a trace that was cut off and starts again with the same memory goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Protocol

import numpy as np

from physworld.errors import Cancelled, CFLViolation, SimulationError
from physworld.mpm.total_lagrangian import TotalLagrangian, run_again_if_blown_up
from physworld.twin import Twin

Progress = Callable[[int, int, str], None]


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
        """Digest of everything that the result depends on; ``drive`` stands for times and controls."""
        digest = hashlib.sha256(drive)
        arrays = self.twin.to_arrays()
        for name in sorted(arrays):
            value = np.ascontiguousarray(arrays[name])
            digest.update(f"{name} {value.dtype} {value.shape}".encode())
            digest.update(value.tobytes())
        digest.update(json.dumps([self.frames, self.step_share]).encode())
        return digest.hexdigest()


@dataclass(frozen=True)
class Drive:
    """What drives every simulation of a scene: control track (Tc,), (Tc, K, 3) and frame times (T,)."""

    control_times: np.ndarray
    control_points: np.ndarray
    times: np.ndarray

    def digest(self) -> bytes:
        """Fingerprint."""
        digest = hashlib.sha256()
        for value in (self.control_times, self.control_points, self.times):
            digest.update(np.ascontiguousarray(value, dtype=float).tobytes())
        return digest.digest()


def nodes_of(job: Job, drive: Drive, poll: Callable[[int, int], None] | None = None) -> np.ndarray:
    """Nodes (frames, n, 3) [m] of a job. Raises SimulationError."""
    run = job.twin.integration(drive.control_times, drive.control_points, drive.times[: job.frames])
    solver = TotalLagrangian(run.problem)
    if solver.stage_s < job.least_step_s:
        raise CFLViolation(
            f"{solver.stage_s:.3g} s for an evaluation of the forces is below {job.least_step_s:.3g} s, which a "
            "trace waits for"
        )
    if job.step_share != 1.0:
        solver = TotalLagrangian(run.problem, job.step_share * solver.time_step_s)
    nodes = run_again_if_blown_up(solver, job.twin.body.start, run.velocity, run.held, run.knots, poll)
    return run.at_frames(job.twin.body.start, nodes)


def stage_s(twin: Twin, drive: Drive) -> float:
    """How far one evaluation of its forces brings a twin [s]: its stable time step, or a stage of its friction."""
    run = twin.integration(drive.control_times, drive.control_points, drive.times[:2])
    return TotalLagrangian(run.problem).stage_s


def tracks_of(job: Job, drive: Drive, poll: Callable[[int, int], None] | None = None) -> np.ndarray | None:
    """Observed points (frames, N, 3) [m] of a job; None where the run cannot be trusted."""
    try:
        nodes = nodes_of(job, drive, poll)
    except SimulationError:
        return None
    tracks = job.twin.observe(nodes, drive.times[: job.frames])
    return tracks if np.isfinite(tracks).all() else None


class Runner(Protocol):
    """Yields the tracks of jobs in their order; None for a run that cannot be trusted. ``poll`` may raise to stop."""

    def __call__(
        self, jobs: Sequence[Job], drive: Drive, poll: Callable[[], None]
    ) -> Iterator[np.ndarray | None]: ...


def in_turn(jobs: Sequence[Job], drive: Drive, poll: Callable[[], None]) -> Iterator[np.ndarray | None]:
    """The runner of this process."""
    for job in jobs:
        yield tracks_of(job, drive, lambda done, total: poll())


class Workers:
    """A runner over processes of its own, which share Warp's cache of kernels; a context manager."""

    def __init__(self, processes: int = 2) -> None:
        self._pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_quiet)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *failure: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __call__(
        self, jobs: Sequence[Job], drive: Drive, poll: Callable[[], None]
    ) -> Iterator[np.ndarray | None]:
        """Every job in a process; ``poll`` is called before each is waited for."""
        futures = [
            self._pool.submit(_work, job.twin.to_arrays(), job.twin.device, _facts(job), drive)
            for job in jobs
        ]
        for future in futures:
            poll()
            yield future.result()


def _quiet() -> None:
    import warp as wp

    wp.config.quiet = True


def _facts(job: Job) -> tuple[int, float, float]:
    return job.frames, job.step_share, job.least_step_s


def _work(
    arrays: dict[str, np.ndarray], device: str, facts: tuple[int, float, float], drive: Drive
) -> np.ndarray | None:
    return tracks_of(Job(Twin.from_arrays(arrays, device), *facts), drive)


class Memory:
    """Tracks by fingerprint, in a folder if one is given."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder, self._known = folder, {}  # type: ignore[var-annotated]
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def get(self, key: str) -> tuple[bool, np.ndarray | None]:
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

    def put(self, key: str, tracks: np.ndarray | None) -> None:
        """Remember a run; one that failed as an empty array."""
        if self._folder is None:
            self._known[key] = tracks
            return
        part = self._folder / f"{key}.part.npy"
        np.save(part, np.empty(0) if tracks is None else tracks, allow_pickle=False)
        part.replace(self._folder / f"{key}.npy")


class Simulations:
    """Counts, remembers, reports and stops.

    Attributes:
        count: runs asked for, those remembered included.
        stage: what they are for.
        least_step_s: a twin that needs a smaller time step is not run.
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
        self.stage, self.least_step_s = "", 0.0

    def run(self, jobs: Sequence[Job]) -> list[np.ndarray | None]:
        """Tracks of every job. Raises Cancelled."""
        return self.under(self.drive, jobs)

    def under(self, drive: Drive, jobs: Sequence[Job]) -> list[np.ndarray | None]:
        """Tracks of every job under this drive. Raises Cancelled."""
        digest = drive.digest()
        keys = [job.fingerprint(digest) for job in jobs]
        known = [self._memory.get(key) for key in keys]
        missing = [k for k, (found, _) in enumerate(known) if not found]
        tracks = [found for _, found in known]
        self.count += len(jobs) - len(missing)
        waiting = [replace(jobs[k], least_step_s=self.least_step_s) for k in missing]
        fresh = self._runner(waiting, drive, self._poll) if missing else iter(())
        for k, made in zip(missing, fresh, strict=True):
            self._memory.put(keys[k], made)
            tracks[k] = made
            self.count += 1
            if self._progress is not None:
                self._progress(self.count, 0, self.stage)
        return tracks

    def elsewhere(self, drive: Drive) -> Simulations:
        """Simulations under another drive, with the same runner, memory and watchers; their count goes on from here."""
        other = Simulations(drive, self._runner, self._memory, self._progress, self._cancelled)
        other.count, other.stage, other.least_step_s = self.count, self.stage, self.least_step_s
        return other

    def _poll(self) -> None:
        if self._cancelled is not None and self._cancelled():
            raise Cancelled(f"trace cancelled after {self.count} simulations in the stage {self.stage!r}")
