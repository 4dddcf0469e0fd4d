"""Laws of the leases: one holder at a time, nothing from a lost lease, capped failures."""

from __future__ import annotations

import threading
from collections.abc import Callable
from datetime import timedelta
from typing import TYPE_CHECKING

import pytest
from sqlalchemy.orm import Session

from physworld_schemas.base import Problem
from physworld_schemas.job import Progress
from physworld_schemas.model import TrainingCreate
from physworld_schemas.queues import SIMULATION, TRAINING
from physworld_storage import resources
from physworld_storage.clock import CLOCK
from physworld_storage.database import Database
from physworld_storage.errors import ResultInvalid
from physworld_storage.jobs import events, jobs, leases
from physworld_storage.jobs.flow import CANCEL_WITHIN_S
from physworld_storage.tables import ShardRow, utc_now

if TYPE_CHECKING:
    from conftest import Work

    from physworld_storage.jobs.leases import Lease

LEASE_SECONDS = 30.0


def put_forward(session: Session, seconds: float) -> None:
    """Put the clock of this transaction forward."""
    session.info[CLOCK] = lambda: utc_now() + timedelta(seconds=seconds)


def expire(work: Work, lease: Lease) -> list[str]:
    """Let the lease run out and reap."""
    with work.database.session() as session:
        put_forward(session, LEASE_SECONDS + 1)
        return leases.reap(session)


def shard(work: Work, shard_id: str) -> ShardRow:
    with work.database.reading() as session:
        return session.get_one(ShardRow, shard_id)


def test_of_many_claimers_one_wins(work: Work) -> None:
    work.fit()
    (shard_id,) = work.waiting()
    claimers = 8
    barrier = threading.Barrier(claimers)
    won: list[Lease] = []

    def claim(owner: str) -> None:
        barrier.wait()
        with work.database.session() as session:
            lease = leases.claim(session, shard_id, owner, LEASE_SECONDS)
        if lease is not None:
            won.append(lease)

    threads = [threading.Thread(target=claim, args=(f"worker-{number}",)) for number in range(claimers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [lease.epoch for lease in won] == [1]


def test_an_unknown_or_finished_shard_cannot_be_claimed(work: Work) -> None:
    work.fit()
    lease = work.claim()
    assert work.complete(lease)
    with work.database.session() as session:
        assert leases.claim(session, "shd_unknown", "worker", LEASE_SECONDS) is None
        assert leases.claim(session, lease.shard_id, "worker", LEASE_SECONDS) is None


def test_a_lost_lease_can_do_nothing(work: Work) -> None:
    job = work.fit()
    late = work.claim(owner="slow")
    assert expire(work, late) == [late.shard_id]
    current = work.claim(owner="quick")
    assert current.epoch == late.epoch + 1
    with work.database.session() as session:
        assert leases.renew(session, late, LEASE_SECONDS) == "lost"
        assert leases.complete(session, late, work.result(late), None) is False
        assert leases.release(session, late) is False
        assert leases.mark_cancelled(session, late) is False
    assert work.fail(late, retry=False) == "lost"
    assert work.job(job).state == "running"
    assert work.complete(current)
    assert work.job(job).state == "succeeded"


def test_a_result_is_committed_once(work: Work) -> None:
    work.fit()
    lease = work.claim()
    assert work.complete(lease)
    assert not work.complete(lease)


def test_renew_prolongs_the_lease(work: Work) -> None:
    work.fit()
    lease = work.claim()
    with work.database.session() as session:
        put_forward(session, 20)
        assert leases.renew(session, lease, LEASE_SECONDS) == "held"
    with work.database.session() as session:
        put_forward(session, 20 + LEASE_SECONDS - 1)
        assert leases.reap(session) == []
        put_forward(session, 20 + LEASE_SECONDS + 1)
        assert leases.reap(session) == [lease.shard_id]


def test_progress_of_a_long_shard_is_the_jobs(work: Work) -> None:
    job = work.fit()
    lease = work.claim()
    progress = Progress(done=12, total=80, unit="simulations", message="loss 3e-4")
    with work.database.session() as session:
        leases.renew(session, lease, LEASE_SECONDS, progress)
    told = progress.model_copy(update={"fraction": 12 / 80})
    assert work.job(job).progress == told
    with work.database.reading() as session:
        last = events.events_after(session, job.id, 0)[-1]
    assert (last.type, last.data["done"]) == ("progress", 12)


def test_progress_of_a_dataset_counts_episodes(work: Work) -> None:
    job = work.dataset(episodes=3)
    work.complete(work.claim())
    lease = work.claim()
    with work.database.session() as session:
        leases.renew(session, lease, LEASE_SECONDS, Progress(done=7, total=10, unit="frames"))
    assert work.job(job).progress.done == 0
    work.complete(lease)
    progress = work.job(job).progress
    assert (progress.done, progress.total, progress.unit) == (1, 3, "episodes")


def test_a_retried_failure_waits_and_is_capped(work: Work) -> None:
    job = work.fit()
    waits = []
    for _ in range(4):
        lease = work.claim()
        before = utc_now()
        assert work.fail(lease, retry=True) == "held"
        row = shard(work, lease.shard_id)
        assert row.not_before is not None
        waits.append(round((row.not_before - before).total_seconds()))
        with work.database.session() as session:
            put_forward(session, -5)
            assert leases.claim(session, lease.shard_id, "early", LEASE_SECONDS) is None
            row = session.get_one(ShardRow, lease.shard_id)
            row.not_before = None
    assert waits == [1, 2, 4, 8]
    work.fail(work.claim(), retry=True, detail="connection refused")
    error = work.job(job).error
    assert error is not None
    assert error.detail == "attempt 5 of 5 failed: connection refused"


def test_a_failure_without_retry_fails_the_job_with_its_problem(work: Work) -> None:
    job = work.fit()
    work.fail(work.claim(), retry=False)
    ended = work.job(job)
    assert ended.state == "failed"
    assert ended.error is not None
    assert ended.error.code == "cfl_violation"
    with work.database.reading() as session:
        assert resources.get_fit(session, job.outputs[0].id).state == "failed"


def test_a_released_shard_costs_no_attempt(work: Work) -> None:
    work.fit()
    for _ in range(7):
        lease = work.claim()
        assert lease.attempt == 1
        with work.database.session() as session:
            assert leases.release(session, lease)


def test_an_invalid_result_changes_nothing(work: Work) -> None:
    job = work.fit()
    lease = work.claim()
    with pytest.raises(ResultInvalid, match=r"metrics\.track_m is nan"):
        work.complete(lease, metrics={"track_m": float("nan")})
    assert work.job(job).state == "running"
    assert work.complete(lease)


def test_a_transaction_that_breaks_leaves_no_trace(work: Work) -> None:
    job = work.dataset(episodes=2)
    work.complete(work.claim())
    lease = work.claim()
    with pytest.raises(ZeroDivisionError):
        with work.database.session() as session:
            assert leases.complete(session, lease, work.result(lease), None)
            raise ZeroDivisionError
    assert shard(work, lease.shard_id).state == "RUNNING"
    with work.database.reading() as session:
        assert resources.all_episodes(session, job.outputs[0].id) == []
        assert resources.get_dataset(session, job.outputs[0].id).episodes_done == 0


def test_published_shards_are_not_published_again_until_they_are_stale(work: Work) -> None:
    work.fit()
    with work.database.session() as session:
        found = leases.publishable(session)
        assert [publication.queue for publication in found] == [SIMULATION]
        leases.mark_published(session, found)
    with work.database.reading() as session:
        put_forward(session, 59)
        assert leases.publishable(session) == []
        put_forward(session, 61)
        assert leases.publishable(session) == found


def test_marking_published_spares_a_shard_that_was_claimed_and_requeued_meanwhile(work: Work) -> None:
    work.fit()
    with work.database.reading() as session:
        found = leases.publishable(session)
    lease = work.claim()
    expire(work, lease)
    with work.database.session() as session:
        leases.mark_published(session, found)
    with work.database.reading() as session:
        again = leases.publishable(session)
    assert [(publication.shard_id, publication.epoch) for publication in again] == [(lease.shard_id, 1)]


def test_only_a_window_of_a_long_queue_is_announced(work: Work) -> None:
    work.dataset(episodes=30)
    work.complete(work.claim())
    with work.database.session() as session:
        first = leases.publishable(session, limit=4, window=6)
        leases.mark_published(session, first)
        second = leases.publishable(session, limit=4, window=6)
        leases.mark_published(session, second)
        assert leases.publishable(session, limit=4, window=6) == []
    assert (len(first), len(second)) == (4, 2)
    rows = [shard(work, publication.shard_id).index for publication in first + second]
    assert rows == [0, 1, 2, 3, 4, 5]


def test_a_long_simulation_queue_does_not_hold_up_training(work: Work) -> None:
    work.finish(work.dataset(episodes=1))
    with work.database.reading() as session:
        dataset = resources.list_datasets(session).data[0]
    work.dataset(episodes=30)
    work.complete(work.claim())
    with work.database.session() as session:
        jobs.create_training(session, TrainingCreate(name="beam", dataset_id=dataset.id))
        found = leases.publishable(session, limit=5, window=5)
    assert {publication.queue for publication in found} == {SIMULATION, TRAINING}


def test_recovery_ends_every_lease_and_forgets_every_message(work: Work) -> None:
    work.dataset(episodes=3)
    work.complete(work.claim())
    lease = work.claim()
    with work.database.session() as session:
        leases.mark_published(session, leases.publishable(session))
        assert leases.recover(session) == 1
        assert leases.reap(session) == [lease.shard_id]
        assert len(leases.publishable(session)) == 3


def test_leases_of_the_provably_dead_end_at_once(work: Work) -> None:
    work.dataset(episodes=2)
    work.complete(work.claim())
    dead, alive = work.claim(owner="dead"), work.claim(owner="alive")
    with work.database.session() as session:
        assert leases.end_leases_of(session, lambda owner: owner == "dead") == 1
        assert leases.reap(session) == [dead.shard_id]
    assert not work.complete(dead)
    assert work.complete(alive)


def test_reapers_at_the_same_time_requeue_a_shard_once(work: Work) -> None:
    work.dataset(episodes=6)
    work.complete(work.claim())
    held = [work.claim() for _ in range(6)]
    barrier = threading.Barrier(4)
    reaped: list[str] = []

    def reap() -> None:
        barrier.wait()
        with work.database.session() as session:
            put_forward(session, LEASE_SECONDS + 1)
            found = leases.reap(session)
        reaped.extend(found)

    threads = [threading.Thread(target=reap) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(reaped) == sorted(lease.shard_id for lease in held)


def test_the_last_two_episodes_at_once_start_the_seal_once(work: Work) -> None:
    job = work.dataset(episodes=4)
    work.complete(work.claim())
    held = [work.claim() for _ in range(4)]
    barrier = threading.Barrier(4)
    committed: list[bool] = []

    def complete(lease: Lease) -> None:
        barrier.wait()
        committed.append(work.complete(lease))

    threads = [threading.Thread(target=complete, args=(lease,)) for lease in held]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert committed == [True] * 4
    seal = work.claim()
    assert seal.kind == "dataset_seal"
    assert work.waiting() == []
    work.complete(seal)
    with work.database.reading() as session:
        dataset = resources.get_dataset(session, job.outputs[0].id)
    assert (dataset.state, dataset.episodes_done) == ("sealed", 4)


def test_the_cap_of_the_settings_holds(database_url: str, make_work: Callable[[Database], Work]) -> None:
    database = Database(database_url, max_attempts=1)
    work = make_work(database)
    job = work.fit()
    work.fail(work.claim(), retry=True)
    assert work.job(job).state == "failed"
    database.dispose()


def test_a_problem_survives_the_database_unchanged(work: Work) -> None:
    job = work.fit()
    problem = Problem(title="Boom", status=500, code="boom", detail="E 2.0e6 Pa", hint="less", errors=[])
    lease = work.claim()
    with work.database.session() as session:
        leases.fail(session, lease, problem, retry=False)
    assert work.job(job).error == problem


def test_a_cancelled_job_does_not_wait_for_a_worker_that_is_gone(work: Work) -> None:
    job = work.fit()
    lease = work.claim()
    work.cancel(job)
    with work.database.session() as session:
        assert leases.renew(session, lease, LEASE_SECONDS) == "cancel"  # and the lease is no longer for it
        assert leases.reap(session) == []
    with work.database.session() as session:
        put_forward(session, CANCEL_WITHIN_S + 0.1)
        assert leases.reap(session) == [lease.shard_id]
    assert work.job(job).state == "cancelled"
    with work.database.session() as session:
        assert leases.renew(session, lease, LEASE_SECONDS) == "lost"
