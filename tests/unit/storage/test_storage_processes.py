"""The state machine under real processes: several workers, SIGKILL at any moment, a fork."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import time
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import func, select

from physworld_storage import resources
from physworld_storage.database import Database
from physworld_storage.jobs import leases
from physworld_storage.tables import EpisodeRow, JobRow, ShardRow

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from ctypes import c_int

    from conftest import Work

SPAWN = multiprocessing.get_context("spawn")
EPISODES = 100
KILLS = 4
PART = EPISODES // (KILLS + 1)  # of the episodes, between one kill and the next
LEASE_SECONDS = 0.6
DEADLINE_SECONDS = 120.0


def episode_result(lease: leases.Lease) -> dict[str, object]:
    return {
        "index": lease.index,
        "path": f"{lease.payload['dataset_id']}/{lease.index}-e{lease.epoch}",
        "digest": f"{lease.index:064x}",
        "seed": lease.index,
        "frames": 10,
        "particles": 5,
    }


def work_episodes(url: str, owner: str, allowed: c_int) -> None:
    """A worker: takes whatever episode waits, while no more are stored than are allowed so far."""
    database = Database(url)
    while True:
        if _done(database) >= allowed.value:
            time.sleep(0.02)
            continue
        with database.session() as session:
            waiting = leases.publishable(session, limit=3, republish_seconds=1e-9, window=10_000)
        episodes = [publication for publication in waiting if publication.kind == "episode"]
        if not episodes:
            time.sleep(0.02)
            continue
        with database.session() as session:
            lease = leases.claim(session, random.choice(episodes).shard_id, owner, LEASE_SECONDS)
        if lease is None:
            continue
        time.sleep(0.01)
        with database.session() as session:
            leases.complete(session, lease, episode_result(lease), None)


def die_before_commit(url: str, lease: leases.Lease) -> None:
    """Do everything that completing a shard means, and die with the transaction open."""
    database = Database(url)
    with database.session() as session:
        assert leases.complete(session, lease, episode_result(lease), None)
        session.flush()
        os.kill(os.getpid(), signal.SIGKILL)


def start(url: str, number: int, allowed: c_int) -> BaseProcess:
    process = SPAWN.Process(target=work_episodes, args=(url, f"worker-{number}", allowed), daemon=True)
    process.start()
    return process


def test_killed_workers_lose_nothing_and_double_nothing(
    work: Work, database: Database, database_url: str
) -> None:
    job = work.dataset(episodes=EPISODES)
    work.complete(work.claim())
    allowed = SPAWN.RawValue("i", PART)  # without a lock, which a killed worker might hold
    workers = [start(database_url, number, allowed) for number in range(2)]
    chance = random.Random(7)
    kills, stop_at = 0, time.monotonic() + DEADLINE_SECONDS
    while not _sealing(database) and time.monotonic() < stop_at:
        time.sleep(chance.uniform(0.01, 0.05))
        if kills < KILLS and _done(database) > PART * kills + 3:
            victim = workers[kills % 2]
            os.kill(victim.pid or 0, signal.SIGKILL)
            victim.join()
            workers[kills % 2] = start(database_url, 10 + kills, allowed)
            kills += 1
            allowed.value = PART * (kills + 1)
        with database.session() as session:
            leases.reap(session)
    for worker in workers:
        worker.kill()
        worker.join()
    assert kills == KILLS
    dataset_id = job.outputs[0].id
    with database.reading() as session:
        episodes = resources.all_episodes(session, dataset_id)
        finished = session.scalars(
            select(ShardRow).where(ShardRow.kind == "episode", ShardRow.state == "DONE")
        ).all()
    assert [episode.index for episode in episodes] == list(range(EPISODES))
    assert [episode.digest for episode in episodes] == [f"{index:064x}" for index in range(EPISODES)]
    assert len(finished) == EPISODES
    work.complete(work.claim())
    assert work.job(job).state == "succeeded"


def test_a_process_killed_before_its_commit_has_changed_nothing(
    work: Work, database: Database, database_url: str
) -> None:
    job = work.dataset(episodes=1)
    work.complete(work.claim())
    lease = work.claim()
    process = SPAWN.Process(target=die_before_commit, args=(database_url, lease))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    with database.reading() as session:
        row = session.get_one(ShardRow, lease.shard_id)
        assert (row.state, row.epoch, row.result) == ("RUNNING", lease.epoch, None)
        assert resources.all_episodes(session, job.outputs[0].id) == []
        assert session.get_one(JobRow, job.id).stage_done == 0
    assert work.complete(lease)
    assert work.claim().kind == "dataset_seal"


def test_a_forked_child_uses_connections_of_its_own(work: Work, database: Database) -> None:
    job = work.fit()
    child = os.fork()
    if child == 0:
        found = work.job(job).state
        database.dispose()
        os._exit(0 if found == "queued" else 1)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0
    assert work.finish(job).state == "succeeded"


def _done(database: Database) -> int:
    with database.reading() as session:
        return session.scalar(select(func.count()).select_from(EpisodeRow)) or 0


def _sealing(database: Database) -> bool:
    with database.reading() as session:
        seal = select(func.count()).select_from(ShardRow).where(ShardRow.kind == "dataset_seal")
        return bool(session.scalar(seal))
