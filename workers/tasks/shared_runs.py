"""Simulations of a long job, shared with whatever worker is free.

The shard that decides (the driver: a trace, a fit) puts simulations that do not depend on each other up as
``simulation`` shards of its own job, which other workers take from the queue and the driver takes itself
(``physworld_storage.jobs.helpers``). Every simulation is kept in the job's scratch folder under its fingerprint, and so
is the journal of the driver's calibration.
"""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.calibrate import Journal
from physworld.estimation.simulations import Drive, Job, engine, tracks_of
from physworld.trace import Memory, TimeUp
from physworld.twin.twin import Twin
from physworld_storage.errors import NotFound
from physworld_storage.jobs import helpers
from physworld_storage.jobs.shards import DONE, QUEUED
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.errors import Cancelled
from physworld_workers.execute import Runtime, run_shard
from physworld_workers.owner import process_owner
from physworld_workers.stores import Stores
from physworld_workers.tasks.inputs import npz_arrays, npz_bytes

JOURNAL = "calibration.json"
LOOK_S = 0.1
_TIMED = 2  # simulations by whose times a driver tells whether sharing is worth it


def simulate(context: TaskContext, stores: Stores) -> HandlerResult:
    """One simulation that a driver put up: from the scratch, to the scratch."""
    job_id, payload = context.lease.job_id, context.lease.payload
    drive = stores.cached(
        ("drive", job_id, payload["drive"]), lambda: _read_drive(stores, job_id, payload["drive"])
    )
    twin = Twin.from_arrays(_read(stores, job_id, payload["twin"]), stores.settings.device)
    tracks = tracks_of(Job(twin, **payload["job"]), drive, lambda done, total: context.check())
    context.check()
    SharedMemory(stores, job_id).put(payload["key"], tracks)
    return HandlerResult({"trusted": tracks is not None})


def stored_journal(stores: Stores, job_id: str, payload: dict[str, Any]) -> Journal:
    """The journal of an earlier attempt at the same payload by this engine, or an empty one; kept after every step."""
    stored = stores.scratch.get(job_id, JOURNAL)
    return Journal(
        f"{engine()} {json.dumps(payload, sort_keys=True)}",
        None if stored is None else stored.decode(),
        lambda text: stores.scratch.put(job_id, JOURNAL, text.encode()),
    )


class SharedMemory(Memory):
    """Tracks by fingerprint in the job's scratch folder; a run that cannot be trusted is an empty array."""

    def __init__(self, stores: Stores, job_id: str) -> None:
        super().__init__()
        self._stores, self._job_id = stores, job_id

    def get(self, key: str) -> tuple[bool, Array | None]:
        """Whether the run is known, and its tracks."""
        data = self._stores.scratch.get(self._job_id, f"{key}.npy")
        if data is None:
            return False, None
        tracks = np.load(io.BytesIO(data), allow_pickle=False)
        return True, tracks if tracks.size else None

    def put(self, key: str, tracks: Array | None) -> None:
        """Remember a run, unless it is known."""
        if self._stores.scratch.has(self._job_id, f"{key}.npy"):
            return
        buffer = io.BytesIO()
        np.save(buffer, np.empty(0) if tracks is None else tracks, allow_pickle=False)
        self._stores.scratch.put(self._job_id, f"{key}.npy", buffer.getvalue())


class SharedRunner:
    """A runner over helper shards; a single simulation is run here at once.

    ``worth_s``: a simulation that takes less is not worth what sharing it costs; with it the first two of the driver
    are run here, and what follows is shared unless one took less.
    """

    def __init__(self, context: TaskContext, stores: Stores, worth_s: float = 0.0) -> None:
        self._context, self._stores, self._worth_s = context, stores, worth_s
        self._fastest_s, self._timed = float("inf"), 0
        self._job_id = context.lease.job_id
        self._memory = SharedMemory(stores, self._job_id)
        self._runtime = Runtime(stores.settings, stores.database, stores, process_owner())
        self._count = 0

    def __call__(self, jobs: Sequence[Job], drive: Drive, poll: Callable[[], None]) -> Iterator[Array | None]:
        """Tracks of the jobs in their order; None for a run that cannot be trusted."""
        while jobs and (len(jobs) == 1 or not self._worth_sharing):
            yield self._here(jobs[0], drive, poll)
            jobs = jobs[1:]
        if not jobs:
            return
        keys = [job.fingerprint(drive.digest()) for job in jobs]
        shards = self._put_up(jobs, keys, drive)
        for shard, key in zip(shards, keys, strict=True):
            try:
                while not self._done(shard, shards, poll):
                    time.sleep(LOOK_S)
            except TimeUp:  # the trace goes on without them, and so do the workers
                with self._stores.database.session() as session:
                    helpers.call_off(session, self._job_id)
                raise
            known, tracks = self._memory.get(key)
            if not known:
                raise NotFound("scratch file", f"{key}.npy of {self._job_id}")
            yield tracks

    @property
    def _worth_sharing(self) -> bool:
        return self._worth_s == 0.0 or (self._timed >= _TIMED and self._fastest_s >= self._worth_s)

    def _here(self, job: Job, drive: Drive, poll: Callable[[], None]) -> Array | None:
        begun = time.monotonic()
        tracks = tracks_of(job, drive, lambda done, total: poll())
        if tracks is not None:  # one that blew up ended early
            self._fastest_s = min(self._fastest_s, time.monotonic() - begun)
            self._timed += 1
        return tracks

    def _put_up(self, jobs: Sequence[Job], keys: Sequence[str], drive: Drive) -> list[str]:
        """Write what the simulations read, then announce them. Raises LeaseLost, Cancelled."""
        scratch, place = self._stores.scratch, f"drive-{drive.digest().hex()[:32]}.npz"
        if not scratch.has(self._job_id, place):
            scratch.put(self._job_id, place, npz_bytes(vars(drive)))
        payloads = []
        for job, key in zip(jobs, keys, strict=True):
            scratch.put(self._job_id, f"{key}.twin.npz", npz_bytes(job.twin.to_arrays()))
            facts = {name: value for name, value in vars(job).items() if name != "twin"}
            payloads.append({"key": key, "twin": f"{key}.twin.npz", "drive": place, "job": facts})
        with self._stores.database.session() as session:
            shards = helpers.put_up(session, self._context.lease, self._count, payloads)
        self._count += len(payloads)
        if len(shards) != len(payloads):
            self._context.check()
            raise Cancelled(f"job {self._job_id} goes on elsewhere")
        return shards

    def _done(self, shard: str, shards: Sequence[str], poll: Callable[[], None]) -> bool:
        """Whether a shard is done, after doing one of those that nobody has taken, the last one first."""
        poll()
        with self._stores.database.reading() as session:
            states = helpers.states_of(session, shards)
        if states[shard] == DONE:
            return True
        waiting = [known for known in reversed(shards) if states[known] == QUEUED]
        for known in waiting:
            if run_shard(self._runtime, known) != "not claimed":
                break
        self._context.check()
        return False


def _read_drive(stores: Stores, job_id: str, name: str) -> Drive:
    return Drive(**_read(stores, job_id, name))


def _read(stores: Stores, job_id: str, name: str) -> dict[str, Array]:
    data = stores.scratch.get(job_id, name)
    if data is None:
        raise NotFound("scratch file", f"{name} of {job_id}")
    return npz_arrays(data)
