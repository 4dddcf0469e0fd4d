"""What becomes of a shard when its handler ends, fails, is cancelled, is overtaken or is stopped."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from physworld.errors import CFLViolation, UnstableSimulation
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job
from physworld_storage.errors import DatabaseUnavailable, StoreReadFailed, StoreWriteFailed
from physworld_storage.jobs import jobs, leases
from physworld_storage.tables import ShardRow
from physworld_workers import execute
from physworld_workers.context import HandlerResult, TaskContext
from physworld_workers.errors import Cancelled
from physworld_workers.execute import Runtime, problem_of, run_shard
from physworld_workers.stores import Stores

pytestmark = pytest.mark.slow

FIT_RESULT = {"parameters": {}, "metrics": {}, "artifacts": []}


@pytest.fixture
def job(stores: Stores, scene_id: str) -> Iterator[Job]:
    with stores.database.session() as session:
        return jobs.create_fit(session, scene_id, FitConfig())


def _shard(stores: Stores) -> ShardRow:
    with stores.database.reading() as session:
        return session.query(ShardRow).one()


def _job(stores: Stores, job: Job) -> Job:
    with stores.database.reading() as session:
        return jobs.get_job(session, job.id)


def _succeed(context: TaskContext, stores: Stores) -> HandlerResult:
    return HandlerResult(FIT_RESULT, "a" * 64)


def test_a_finished_shard_is_committed_with_its_digest(runtime_with, stores: Stores, job: Job) -> None:
    assert run_shard(runtime_with(fit=_succeed), _shard(stores).id) == "done"
    assert (_shard(stores).state, _shard(stores).digest) == ("DONE", "a" * 64)
    assert _job(stores, job).state == "succeeded"


def test_a_second_message_for_the_same_shard_does_nothing(runtime_with, stores: Stores, job: Job) -> None:
    runtime: Runtime = runtime_with(fit=_succeed)
    shard_id = _shard(stores).id
    assert [run_shard(runtime, shard_id), run_shard(runtime, shard_id)] == ["done", "not claimed"]
    assert run_shard(runtime, "shd_unknown") == "not claimed"


def test_physics_fails_at_once_and_keeps_its_numbers(runtime_with, stores: Stores, job: Job) -> None:
    def explode(context: TaskContext, stores: Stores) -> HandlerResult:
        raise UnstableSimulation("12 of 400 nodes are not finite after step 31")

    assert run_shard(runtime_with(fit=explode), _shard(stores).id) == "failed"
    failed = _job(stores, job)
    assert failed.state == "failed" and failed.error is not None
    assert (failed.error.code, failed.error.status) == ("unstable_simulation", 422)
    assert failed.error.detail == "12 of 400 nodes are not finite after step 31"
    assert failed.error.hint is not None  # filled by its code


def test_infrastructure_is_tried_again_until_the_attempts_are_spent(
    runtime_with, stores: Stores, job: Job
) -> None:
    def unreachable(context: TaskContext, stores: Stores) -> HandlerResult:
        raise ConnectionResetError("connection to the store reset after 3 s")

    runtime: Runtime = runtime_with(fit=unreachable)
    shard_id = _shard(stores).id
    for attempt in range(1, runtime.settings.max_attempts + 1):
        assert _shard(stores).state == "QUEUED"
        assert run_shard(runtime, shard_id) == "retried"
        assert _shard(stores).attempt == attempt
        with stores.database.session() as session:
            session.get_one(ShardRow, shard_id).not_before = datetime.now(UTC) - timedelta(seconds=1)
    failed = _job(stores, job)
    assert failed.state == "failed" and failed.error is not None
    assert "attempt 5 of 5" in failed.error.detail
    assert "reset after 3 s" in failed.error.detail


def test_a_bug_fails_the_shard_and_is_raised_for_the_log(runtime_with, stores: Stores, job: Job) -> None:
    def divide(context: TaskContext, stores: Stores) -> HandlerResult:
        return HandlerResult({"value": 1 // 0})

    with pytest.raises(ZeroDivisionError):
        run_shard(runtime_with(fit=divide), _shard(stores).id)
    error = _job(stores, job).error
    assert error is not None and error.code == "zero_division_error" and error.status == 500


def test_a_result_of_the_wrong_form_is_not_committed(runtime_with, stores: Stores, job: Job) -> None:
    def odd(context: TaskContext, stores: Stores) -> HandlerResult:
        return HandlerResult({"metrics": {"track_m": float("nan")}})

    assert run_shard(runtime_with(fit=odd), _shard(stores).id) == "failed"
    error = _job(stores, job).error
    assert error is not None and error.code == "result_invalid" and "track_m" in error.detail


def test_a_cancelled_job_stops_its_handler(runtime_with, stores: Stores, job: Job) -> None:
    def wait_for_cancel(context: TaskContext, stores: Stores) -> HandlerResult:
        with stores.database.session() as session:
            jobs.cancel_job(session, job.id)
        while True:
            context.progress(1, 10, "simulations")
            context.check()

    assert run_shard(runtime_with(fit=wait_for_cancel), _shard(stores).id) == "cancelled"
    assert _job(stores, job).state == "cancelled"
    assert _shard(stores).state == "CANCELLED"


def test_a_job_cancelled_before_the_commit_is_cancelled_not_done(
    runtime_with, stores: Stores, job: Job
) -> None:
    def cancel_then_finish(context: TaskContext, stores: Stores) -> HandlerResult:
        with stores.database.session() as session:
            jobs.cancel_job(session, job.id)
        return HandlerResult(FIT_RESULT)

    assert run_shard(runtime_with(fit=cancel_then_finish), _shard(stores).id) == "not committed"
    assert _job(stores, job).state == "cancelled"


def test_an_overtaken_worker_commits_nothing(runtime_with, stores: Stores, job: Job) -> None:
    def be_overtaken(context: TaskContext, stores: Stores) -> HandlerResult:
        with stores.database.session() as session:
            leases.recover(session)
            leases.reap(session)
            leases.claim(session, context.lease.shard_id, "another", 60.0)
        return HandlerResult(FIT_RESULT)

    assert run_shard(runtime_with(fit=be_overtaken), _shard(stores).id) == "not committed"
    assert (_shard(stores).state, _shard(stores).lease_owner) == ("RUNNING", "another")


def test_the_scratch_of_a_job_stays_until_its_result_is_committed(
    runtime_with, stores: Stores, job: Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    def keep(context: TaskContext, stores: Stores) -> HandlerResult:
        stores.scratch.put(job.id, "calibration.json", b"{}")
        return HandlerResult(FIT_RESULT)

    def away(*arguments: object) -> bool:
        raise StoreReadFailed("the store is away")

    with monkeypatch.context() as patch:
        patch.setattr(leases, "complete", away)
        assert run_shard(runtime_with(fit=keep), _shard(stores).id) == "retried"
    assert stores.scratch.has(job.id, "calibration.json")
    with stores.database.session() as session:
        session.query(ShardRow).one().not_before = None
    assert run_shard(runtime_with(fit=keep), _shard(stores).id) == "done"
    assert stores.scratch.jobs() == []


def test_a_scratch_that_cannot_be_removed_does_not_undo_the_commit(
    runtime_with, stores: Stores, job: Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(job_id: str) -> int:
        raise StoreWriteFailed("the store is away")

    monkeypatch.setattr(stores.scratch, "remove", away)
    assert run_shard(runtime_with(fit=_succeed), _shard(stores).id) == "done"


def test_an_overtaken_worker_leaves_the_scratch_to_its_successor(
    runtime_with, stores: Stores, job: Job
) -> None:
    def be_overtaken(context: TaskContext, stores: Stores) -> HandlerResult:
        stores.scratch.put(job.id, "calibration.json", b"{}")
        with stores.database.session() as session:
            leases.recover(session)
            leases.reap(session)
            leases.claim(session, context.lease.shard_id, "another", 60.0)
        raise Cancelled(f"job {job.id} goes on elsewhere")

    assert run_shard(runtime_with(fit=be_overtaken), _shard(stores).id) == "not committed"
    assert stores.scratch.has(job.id, "calibration.json")


@pytest.mark.parametrize("refusals", [2, 1000])
def test_a_commit_waits_for_a_database_that_is_away_while_the_lease_lasts(
    runtime_with, stores: Stores, job: Job, monkeypatch: pytest.MonkeyPatch, refusals: int
) -> None:
    complete, asked = leases.complete, []

    def away(*arguments: Any) -> bool:
        asked.append(arguments)
        if len(asked) <= refusals:
            raise DatabaseUnavailable("the server closed the connection")
        return complete(*arguments)

    monkeypatch.setattr(leases, "complete", away)
    monkeypatch.setattr(execute, "COMMIT_PAUSE_S", 0.2)
    runtime: Runtime = runtime_with(fit=_succeed)
    runtime = replace(runtime, settings=runtime.settings.model_copy(update={"lease_seconds": 2.0}))
    outcome = run_shard(runtime, _shard(stores).id)
    assert outcome == ("done" if refusals == 2 else "retried")
    assert _job(stores, job).state == ("succeeded" if refusals == 2 else "running")


def test_a_worker_that_is_stopped_gives_its_shard_back_untried(
    runtime_with, stores: Stores, job: Job
) -> None:
    def stop(context: TaskContext, stores: Stores) -> HandlerResult:
        raise SystemExit(-241)

    with pytest.raises(SystemExit):
        run_shard(runtime_with(fit=stop), _shard(stores).id)
    shard = _shard(stores)
    assert (shard.state, shard.attempt, shard.lease_owner) == ("QUEUED", 0, None)


def test_problems_carry_code_and_numbers() -> None:
    problem = problem_of(Cancelled("job job_1 was cancelled"))
    assert (problem.code, problem.title) == ("cancelled", "cancelled")
    assert problem_of(OSError(28, "No space left on device")).code == "os_error"
    assert problem_of(CFLViolation("dt 1.0e-4 s exceeds 6.1e-5 s")).code == "cfl_violation"
