"""Traces in the database: helper shards, the scratch store, what follows what in a closed loop."""

from __future__ import annotations

import random
from datetime import timedelta
from typing import TYPE_CHECKING, Any

import pytest

from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.job import Job
from physworld_schemas.model import TrainingConfig
from physworld_schemas.pipeline import PipelineCreate
from physworld_schemas.trace import TraceCreate
from physworld_storage import registry, traces
from physworld_storage.clock import CLOCK
from physworld_storage.database import Database
from physworld_storage.errors import Conflict, ResultInvalid
from physworld_storage.jobs import helpers, jobs, leases
from physworld_storage.scratch import ScratchStore
from physworld_storage.settings import Settings
from physworld_storage.tables import JobRow, ModelVersionRow, ShardRow, utc_now

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from conftest import Work

TWIN = {"name": "twin.npz", "sha256": "0" * 64, "size": 3}
REPORT = {"verdict": "named", "report": {"reason": "so"}, "artifacts": []}


def trace_job(work: Work, database: Database) -> Job:
    scene = work.scene()
    with database.session() as session:
        return jobs.create_trace(session, TraceCreate(scene_id=scene.id))


def put_up(database: Database, driver: leases.Lease, count: int, first: int = 0) -> list[str]:
    with database.session() as session:
        return helpers.put_up(session, driver, first, [{"key": f"k{n}"} for n in range(count)])


def orphan(database: Database, job: Job, index: int = 0) -> None:
    """A helper that a driver put up while its job was being cancelled."""
    with database.session() as session:
        session.add(
            ShardRow(
                id=f"shd_orphan{index}",
                job_id=job.id,
                stage=9,
                index=index,
                kind=helpers.SIMULATION,
                state="QUEUED",
                max_attempts=5,
                created_at=job.created_at,
                payload={},
            )
        )


def states(database: Database, job: Job) -> list[str]:
    with database.reading() as session:
        rows = session.query(ShardRow).where(ShardRow.job_id == job.id, ShardRow.kind == helpers.SIMULATION)
        return sorted(row.state for row in rows)


def test_helpers_are_anybodys_and_do_not_end_their_job(work: Work, database: Database) -> None:
    job = trace_job(work, database)
    driver = work.claim()
    shards = put_up(database, driver, 3)
    assert set(work.waiting()) == set(shards)
    for shard, owner in zip(shards, ("driver", "other", "other"), strict=True):
        lease = work.claim(shard, owner=owner)
        with database.session() as session:
            assert leases.complete(session, lease, {"trusted": True})
    assert work.job(job).state == "running"
    assert len(put_up(database, driver, 2, first=3)) == 2
    with database.session() as session:
        assert leases.complete(session, driver, REPORT)
    assert work.job(job).state == "succeeded"
    assert states(database, job) == ["CANCELLED", "CANCELLED", "DONE", "DONE", "DONE"]
    assert work.waiting() == []


def test_a_driver_that_lost_its_lease_puts_nothing_up(work: Work, database: Database) -> None:
    job = trace_job(work, database)
    first = work.claim()
    assert len(put_up(database, first, 2)) == 2
    with database.session() as session:
        session.info[CLOCK] = lambda: utc_now() + timedelta(hours=1)
        leases.reap(session)
    assert put_up(database, first, 1, first=2) == []
    second = work.claim(first.shard_id)
    with database.session() as session:
        helpers.call_off(session, job.id)
    assert states(database, job) == ["CANCELLED", "CANCELLED"]
    assert len(put_up(database, second, 2)) == 2, "the indices of an earlier attempt are no hindrance"


def test_a_helper_that_fails_fails_the_trace(work: Work, database: Database) -> None:
    job = trace_job(work, database)
    driver = work.claim()
    (shard, _) = put_up(database, driver, 2)
    work.fail(work.claim(shard), retry=False, detail="a bug")
    failed = work.job(job)
    assert failed.state == "failed" and failed.error is not None and "a bug" in failed.error.detail
    with database.session() as session:
        assert not leases.complete(session, driver, REPORT)
        assert traces.get_trace(session, job.outputs[0].id).state == "failed"
    assert states(database, job) == ["CANCELLED", "FAILED"]


def test_a_cancelled_job_is_given_no_helpers(work: Work, database: Database) -> None:
    job = trace_job(work, database)
    driver = work.claim()
    work.cancel(job)
    assert put_up(database, driver, 2) == []
    with database.session() as session:
        leases.mark_cancelled(session, driver)
    assert work.job(job).state == "cancelled" and states(database, job) == []


def test_what_still_waits_when_a_cancel_settles_is_called_off(work: Work, database: Database) -> None:
    job = trace_job(work, database)
    driver = work.claim()
    work.cancel(job)
    orphan(database, job)
    with database.session() as session:
        leases.mark_cancelled(session, driver)
    assert work.job(job).state == "cancelled" and states(database, job) == ["CANCELLED"]


def test_shards_of_ended_jobs_take_no_place_in_the_queue(work: Work, database: Database) -> None:
    ended = trace_job(work, database)
    work.cancel(ended)
    for index in range(3):
        orphan(database, ended, index)
    waiting = trace_job(work, database)
    with database.reading() as session:
        found = leases.publishable(session, limit=1, window=1)
        (wanted,) = session.query(ShardRow.id).where(ShardRow.job_id == waiting.id).one()
    assert [publication.shard_id for publication in found] == [wanted]


def test_a_cancel_waits_for_helpers_that_run(work: Work, database: Database) -> None:
    job = trace_job(work, database)
    driver = work.claim()
    running, _ = put_up(database, driver, 2)
    lease = work.claim(running)
    work.cancel(job)
    with database.session() as session:
        leases.mark_cancelled(session, driver)
    assert work.job(job).state == "cancelling"
    with database.session() as session:
        leases.mark_cancelled(session, lease)
    assert work.job(job).state == "cancelled"
    assert states(database, job) == ["CANCELLED", "CANCELLED"]


@pytest.mark.parametrize("change", [{"verdict": "perhaps"}, {"report": {"score": float("nan")}}])
def test_a_report_of_the_wrong_form_is_refused_before_anything_changes(
    work: Work, database: Database, change: dict[str, Any]
) -> None:
    job = trace_job(work, database)
    driver = work.claim()
    with pytest.raises(ResultInvalid), database.session() as session:
        leases.complete(session, driver, {**REPORT, **change})
    assert work.job(job).state == "running"


def finish(
    work: Work, database: Database, job: Job, verdict: str, clocks: random.Random | None = None
) -> list[str]:
    """Do the whole pipeline with this verdict, made by hosts with such clocks; the kinds of its children."""
    while work.job(job).state in {"queued", "running"}:
        if clocks is not None:
            _set_clocks(database, job, clocks)
        lease = work.claim()
        added = [TWIN] if verdict == "named" else []
        answer = {**REPORT, "verdict": verdict, "artifacts": added}
        result = answer if lease.kind == "trace" else work.result(lease)
        with database.session() as session:
            assert leases.complete(session, lease, result)
    return [work.job(child).kind for child in work.job(job).children]


def _set_clocks(database: Database, job: Job, clocks: random.Random) -> None:
    """The children were made at times that do not tell their order."""
    with database.session() as session:
        for row in session.query(JobRow).where(JobRow.parent_id == job.id):
            row.created_at = job.created_at + timedelta(seconds=clocks.uniform(-3600.0, 3600.0))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("beside", [False, True], ids=["after", "beside"])
def test_what_follows_what_does_not_depend_on_clocks(
    work: Work, database: Database, seed: int, beside: bool
) -> None:
    training = TrainingConfig(start_share=0.5) if beside else TrainingConfig()
    scene = work.scene()
    clocks = random.Random(seed)
    plain = PipelineCreate(scene_id=scene.id, dataset=DatasetConfig(episodes=2), training=training)
    with database.session() as session:
        job = jobs.create_pipeline(session, plain)
    assert sorted(finish(work, database, job, "", clocks)) == ["dataset", "fit", "training"]
    looped = closed_loop(work, database, scene.id, training=training)
    found = sorted(finish(work, database, looped, "named", clocks))
    assert found == ["dataset", "dataset", "fit", "trace", "training", "training"]


def closed_loop(work: Work, database: Database, scene_id: str, **more: Any) -> Job:
    request = PipelineCreate(
        scene_id=scene_id, model_name="beam", close_the_loop=True, dataset=DatasetConfig(episodes=1), **more
    )
    with database.session() as session:
        return jobs.create_pipeline(session, request)


def test_the_comparison_is_made_once_and_found_again(work: Work, database: Database) -> None:
    scene = work.scene()
    long = ["fit", "trace", "dataset", "training", "dataset", "training"]
    short = long[:4]
    assert finish(work, database, closed_loop(work, database, scene.id), "unexplained") == short
    assert finish(work, database, closed_loop(work, database, scene.id), "named") == long
    with database.reading() as session:
        plain, named = (registry.get_version(session, "beam", number) for number in (2, 3))
    assert plain.trace_id is None and named.trace_id is not None
    assert finish(work, database, closed_loop(work, database, scene.id), "named") == short
    other = TrainingConfig(steps=7)
    assert finish(work, database, closed_loop(work, database, scene.id, training=other), "named") == long


def test_a_version_from_before_the_frame_was_a_setting_stood_in_the_worlds_axes(
    work: Work, database: Database
) -> None:
    scene, world = work.scene(), TrainingConfig(frame="world")
    assert len(finish(work, database, closed_loop(work, database, scene.id, training=world), "named")) == 6
    with database.session() as session:
        row = session.get_one(ModelVersionRow, ("beam", 1))
        row.config = {name: value for name, value in row.config.items() if name != "frame"}
    with database.reading() as session:
        assert registry.trained_with(session.get_one(ModelVersionRow, ("beam", 1))) == world
    again = closed_loop(work, database, scene.id, training=world)
    assert "training" in finish(work, database, again, "named")
    assert _baselines(database)[3] == 1, "found again, without a second comparison"
    finish(work, database, closed_loop(work, database, scene.id), "named")
    assert _baselines(database)[5] == 4, "in axes that are chosen: a comparison of its own"


def _baselines(database: Database) -> dict[int, int | None]:
    """What each version is compared with."""
    with database.reading() as session:
        rows = session.query(ShardRow).where(ShardRow.kind == "training").all()
        return {row.payload["version"]: row.payload["baseline"] for row in rows}


def test_the_training_is_told_what_to_compare_with(work: Work, database: Database) -> None:
    job = closed_loop(work, database, work.scene().id)
    finish(work, database, job, "named")
    with database.reading() as session:
        payloads = [row.payload for row in session.query(ShardRow).where(ShardRow.kind == "training")]
    assert sorted((p["version"], p["baseline"], p["trace_id"] is not None) for p in payloads) == [
        (1, None, False),
        (2, 1, True),
    ]


def test_a_dataset_takes_a_ready_trace_of_its_own_scene(work: Work, database: Database) -> None:
    fit = work.finish(work.fit())
    pending = trace_job(work, database)
    with pytest.raises(Conflict, match="needs a ready trace"), database.session() as session:
        jobs.create_dataset(session, fit.outputs[0].id, DatasetConfig(), pending.outputs[0].id)
    driver = work.claim()
    with database.session() as session:
        assert leases.complete(session, driver, REPORT)
    with pytest.raises(Conflict, match="is of scene"), database.session() as session:
        jobs.create_dataset(session, fit.outputs[0].id, DatasetConfig(), pending.outputs[0].id)


def test_scratch_files_are_kept_apart_by_job_and_removed_together(tmp_path: Any) -> None:
    scratch = ScratchStore(Settings(data_dir=tmp_path))
    assert scratch.jobs() == []
    scratch.put("job_a", "x.npy", b"1")
    scratch.put("job_a", "y.npy", b"2")
    scratch.put("job_b", "x.npy", b"3")
    assert scratch.get("job_a", "x.npy") == b"1" and scratch.has("job_b", "x.npy")
    assert scratch.get("job_a", "z.npy") is None and not scratch.has("job_c", "x.npy")
    assert sorted(scratch.jobs()) == ["job_a", "job_b"]
    assert scratch.remove("job_a") == 2
    assert scratch.get("job_a", "y.npy") is None and scratch.jobs() == ["job_b"]
    for job, name in (("../x", "a"), ("job_a", "../a"), ("job_a", ".hidden"), ("", "a")):
        with pytest.raises(ValueError, match="is not the"):
            scratch.put(job, name, b"")
