"""Losses are no failures: workers may die as often as they like, and work that kills them is found all the same."""

from __future__ import annotations

import random
from datetime import timedelta
from typing import TYPE_CHECKING

import pytest

from physworld_schemas.job import Progress
from physworld_storage.clock import CLOCK
from physworld_storage.jobs import leases, losses
from physworld_storage.tables import ShardRow, utc_now

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from conftest import Work

    from physworld_schemas.job import Job

LEASE_S = 30.0
KILLS = 40


class Clock:
    """A time that tests move; it begins at the present."""

    def __init__(self) -> None:
        self.now = utc_now()


def _lose(work: Work, clock: Clock, owner: str, ran_s: float, progress: Progress | None = None) -> None:
    """A worker takes the first shard that waits, renews its lease after ``ran_s`` for the last time, and is gone."""
    with work.database.session() as session:
        session.info[CLOCK] = lambda: clock.now
        (publication, *_) = leases.publishable(session, republish_seconds=1e-9)
        lease = leases.claim(session, publication.shard_id, owner, LEASE_S)
        assert lease is not None
        clock.now += timedelta(seconds=ran_s)
        assert leases.renew(session, lease, LEASE_S, progress) == "held"
        clock.now += timedelta(seconds=LEASE_S + 1)
        assert leases.reap(session) == [lease.shard_id]
        clock.now += timedelta(seconds=losses.LONGEST_PAUSE_S)


def _finished(work: Work, clock: Clock, job: Job) -> bool:
    """Whether the job still runs, and succeeds once a worker lives to the end."""
    with work.database.session() as session:
        session.info[CLOCK] = lambda: clock.now
        (publication,) = leases.publishable(session, republish_seconds=1e-9)
        lease = leases.claim(session, publication.shard_id, "last", LEASE_S)
    assert lease is not None and work.job(job).state == "running"
    return work.complete(lease) and work.job(job).state == "succeeded"


def _lose_until_it_ends(work: Work, job: Job, ran_s: float) -> int:
    clock = Clock()
    for kills in range(1, KILLS):
        _lose(work, clock, f"worker-{kills}", ran_s)
        if work.job(job).state == "failed":
            return kills
    raise AssertionError(f"not found in {KILLS} kills")


@pytest.mark.parametrize("seed", range(5))
def test_workers_that_are_killed_at_random_end_no_job(work: Work, seed: int) -> None:
    job, clock, dice = work.fit(), Clock(), random.Random(seed)
    for kill in range(KILLS):
        _lose(work, clock, f"worker-{kill}", dice.expovariate(1 / 20))
    assert _finished(work, clock, job)


def test_work_that_gets_on_is_not_deadly_however_regular_its_losses(work: Work) -> None:
    job, clock = work.fit(), Clock()
    for kill in range(20):
        _lose(work, clock, f"worker-{kill}", 10.0, Progress(done=kill * 5, total=100, unit="simulations"))
    assert _finished(work, clock, job)


@pytest.mark.parametrize("ran_s", [0.0, 7.0, 300.0])
def test_work_that_kills_its_workers_is_found(work: Work, ran_s: float) -> None:
    job = work.fit()
    assert _lose_until_it_ends(work, job, ran_s) == losses.ALIKE
    error = work.job(job).error
    assert error is not None and error.code == "work_kills_its_workers"
    assert error.type == "urn:physworld:problem:work_kills_its_workers"
    assert "lost 8 times in a row by 8 workers" in error.detail and "worker-8" in error.detail
    assert work.waiting() == []


def test_stops_of_the_whole_service_are_nobodys_losses(work: Work) -> None:
    job = work.fit()
    for _ in range(3 * losses.ALIKE):
        work.claim()
        with work.database.session() as session:
            leases.recover(session)
            assert len(leases.reap(session)) == 1
    assert work.finish(job).state == "succeeded"


def test_kills_at_random_times_are_seldom_alike() -> None:
    """Kills at uniformly distributed times of ten minutes: taken for deadly work in fewer than 1 of 1000 cases."""
    dice = random.Random(0)
    drawn = ([{"ran_s": dice.uniform(0.0, 600.0)} for _ in range(losses.ALIKE)] for _ in range(20_000))
    assert 0 < sum(losses.deadly(times) for times in drawn) < 20


def test_the_pauses_grow_to_a_minute() -> None:
    counted = [losses.pause_s([{}] * count) for count in range(1, 10)]
    assert counted == [0, 1, 2, 4, 8, 16, 32, 60, 60]


def test_losses_and_failures_are_counted_apart(work: Work) -> None:
    job, clock = work.fit(), Clock()
    for kill in range(6):
        _lose(work, clock, f"worker-{kill}", 3.0 * 2.0**kill)
    with work.database.session() as session:
        session.info[CLOCK] = lambda: clock.now
        (publication,) = leases.publishable(session, republish_seconds=1e-9)
        lease = leases.claim(session, publication.shard_id, "last", LEASE_S)
        assert lease is not None and lease.attempt == 7
    assert work.fail(lease, retry=True) == "held"
    with work.database.reading() as session:
        row = session.get_one(ShardRow, lease.shard_id)
        assert (row.failures, len(row.losses or [])) == (1, 6)
    assert work.job(job).state == "running"
