"""A lease is kept alive while a handler works, and the handler learns when it must stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_storage.jobs import events as log
from physworld_storage.jobs import jobs, leases
from physworld_storage.settings import Settings
from physworld_storage.tables import ShardRow
from physworld_workers.context import GRACE_S, TaskContext
from physworld_workers.errors import Cancelled, LeaseLost
from physworld_workers.stores import Stores

WITHIN_S = 10.0
LEASE_S = 2.0
ANSWER_S = 5.0


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WITHIN_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.fixture
def settings(tmp_path) -> Settings:
    return Settings(data_dir=tmp_path / "data", lease_seconds=LEASE_S)


@pytest.fixture
def job(stores: Stores, scene_id: str) -> Job:
    with stores.database.session() as session:
        return jobs.create_fit(session, scene_id, FitConfig())


@pytest.fixture
def lease(stores: Stores, job: Job) -> leases.Lease:
    with stores.database.session() as session:
        shard_id = session.query(ShardRow.id).scalar()
        claimed = leases.claim(session, shard_id, "test", LEASE_S)
    assert claimed is not None
    return claimed


def test_the_lease_outlives_its_first_term(stores: Stores, lease: leases.Lease, settings: Settings) -> None:
    with TaskContext(lease, stores.database, settings) as context:
        time.sleep(1.5 * LEASE_S)
        context.check()
        with stores.database.session() as session:
            assert leases.reap(session) == []


def test_progress_reaches_the_job(stores: Stores, lease: leases.Lease, settings: Settings, job: Job) -> None:
    def progress() -> float:
        with stores.database.reading() as session:
            return jobs.get_job(session, job.id).progress.done

    with TaskContext(lease, stores.database, settings) as context:
        for done in range(1, 1000):
            context.progress(done, 1000, "simulations", "1.2 mm")
        _until(lambda: progress() == 999)
    with stores.database.reading() as session:
        events = [event for event in log.events_after(session, job.id, 0, 500) if event.type == "progress"]
    assert len(events) < 20


def test_the_last_report_of_every_stage_is_written_however_short_it_was(
    stores: Stores, lease: leases.Lease, settings: Settings, job: Job
) -> None:
    with TaskContext(lease, stores.database, settings) as context:
        context.plan({"training": 8.0, "measuring": 1.0, "exporting": 1.0})
        context.begin("training", "steps", 10)
        context.progress(10, 10, "steps", "loss 0.2", {"loss": 0.2})
        context.begin("measuring")
        context.begin("exporting")
        context.progress(1, 1, "files", "model.pt", {"validation_m": 0.003})
    with stores.database.reading() as session:
        told = [event.data for event in log.events_after(session, job.id, 0, 500) if event.type == "progress"]
        figures = log.figures_of(session, job.id)
    fractions = [data["fraction"] for data in told]
    assert fractions == sorted(fractions) and fractions[-1] == 1.0
    assert {name: value for _, one in figures for name, value in one.items()} == {
        "loss": 0.2,
        "validation_m": 0.003,
    }


def test_a_cancel_is_seen_by_a_handler_that_only_polls(
    stores: Stores, lease: leases.Lease, settings: Settings, job: Job
) -> None:
    with TaskContext(lease, stores.database, settings) as context:
        assert not context.cancelled()
        with stores.database.session() as session:
            jobs.cancel_job(session, job.id)
        _until(context.cancelled)
        with pytest.raises(Cancelled, match=job.id):
            context.check()


def test_a_lease_that_another_took_is_lost(stores: Stores, lease: leases.Lease, settings: Settings) -> None:
    with TaskContext(lease, stores.database, settings) as context:
        with stores.database.session() as session:
            leases.recover(session)
            leases.reap(session)

        def lost() -> bool:
            try:
                context.check()
            except LeaseLost:
                return True
            return False

        _until(lost)


def test_a_process_that_could_not_renew_in_time_stops_by_its_own_clock(
    stores: Stores, lease: leases.Lease, settings: Settings
) -> None:
    context = TaskContext(lease, stores.database, settings)  # never entered: nobody renews
    time.sleep(1.1 * LEASE_S)
    with pytest.raises(LeaseLost, match=r"2\.\d s after its last renewal \(lease 2\.0 s\)"):
        context.check()


def test_a_cancelled_handler_that_cannot_be_asked_is_left_behind(
    stores: Stores, lease: leases.Lease, settings: Settings, job: Job
) -> None:
    left = threading.Event()
    with TaskContext(lease, stores.database, settings, left.set):
        with stores.database.session() as session:
            assert jobs.cancel_job(session, job.id).state == "cancelling"
        asked = time.monotonic()
        assert left.wait(WITHIN_S)  # the handler is in a compiler: it neither reports nor checks
        assert time.monotonic() - asked < ANSWER_S
        with stores.database.session() as session:
            assert jobs.get_job(session, job.id).state == "cancelled"
            assert not leases.complete(session, lease, {"parameters": {}, "metrics": {}, "artifacts": []})


def test_a_cancelled_handler_that_stops_in_time_is_not_left_behind(
    stores: Stores, lease: leases.Lease, settings: Settings, job: Job
) -> None:
    left = threading.Event()
    with TaskContext(lease, stores.database, settings, left.set) as context:
        with stores.database.session() as session:
            jobs.cancel_job(session, job.id)
        _until(context.cancelled)
    time.sleep(GRACE_S + 0.5)
    assert not left.is_set()
