"""A failed job is taken up again: what is stored stays, and its pipeline goes on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from physworld_storage import resources
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.jobs import jobs
from physworld_storage.tables import ShardRow

if TYPE_CHECKING:
    from conftest import Work

    from physworld_schemas.job import Job


def _retry(work: Work, job_id: str) -> Job:
    with work.database.session() as session:
        return jobs.retry_job(session, job_id)


def test_a_dataset_goes_on_with_the_episodes_that_it_has(work: Work) -> None:
    job = work.dataset(episodes=4)
    dataset_id = job.outputs[0].id
    work.complete(work.claim())
    for _ in range(2):
        work.complete(work.claim())
    work.fail(work.claim(), retry=False)
    assert work.job(job).state == "failed"
    with work.database.reading() as session:
        before = resources.all_episodes(session, dataset_id)
        assert resources.get_dataset(session, dataset_id).state == "failed"
    assert len(before) == 2

    assert _retry(work, job.id).state == "queued"
    assert len(work.waiting()) == 2
    assert work.finish(job).state == "succeeded"
    with work.database.reading() as session:
        after = resources.all_episodes(session, dataset_id)
        assert resources.get_dataset(session, dataset_id).state == "sealed"
    assert [episode.index for episode in after] == list(range(4))
    assert all(episode in after for episode in before)


def test_a_seal_that_failed_is_sealed_by_a_retry(work: Work) -> None:
    job = work.dataset(episodes=2)
    for _ in range(3):
        work.complete(work.claim())
    work.fail(work.claim(), retry=False)
    _retry(work, job.id)
    assert work.finish(job).state == "succeeded"


@pytest.mark.parametrize("by_child", [False, True])
def test_a_pipeline_goes_on_after_its_failed_child(work: Work, by_child: bool) -> None:
    pipeline = work.pipeline()
    work.complete(work.claim())
    work.complete(work.claim())
    work.fail(work.claim(), retry=False)
    assert work.job(pipeline).state == "failed"
    (fit, dataset) = work.job(pipeline).children
    assert (work.job(fit).state, work.job(dataset).state) == ("succeeded", "failed")

    _retry(work, dataset if by_child else pipeline.id)
    assert (work.job(pipeline).state, work.job(pipeline).error) == ("running", None)
    ended = work.finish(pipeline)
    assert ended.state == "succeeded"
    assert len(ended.children) == 3 and {output.kind for output in ended.outputs} == {
        "fit",
        "dataset",
        "model",
    }


def test_a_model_version_is_published_by_a_retried_training(work: Work) -> None:
    pipeline = work.pipeline(episodes=1)
    for _ in range(4):
        work.complete(work.claim())
    training = work.claim()
    assert training.kind == "training"
    work.fail(training, retry=False)
    _retry(work, pipeline.id)
    again = work.claim()
    assert again.shard_id == training.shard_id and again.epoch == training.epoch + 1
    assert work.complete(again)
    assert work.job(pipeline).state == "succeeded"


def test_counters_begin_anew(work: Work) -> None:
    job = work.fit()
    lease = work.claim()
    work.fail(lease, retry=False)
    _retry(work, job.id)
    with work.database.reading() as session:
        row = session.get_one(ShardRow, lease.shard_id)
    assert (row.state, row.failures, row.losses, row.error) == ("QUEUED", 0, [], None)
    assert not work.complete(lease)  # the attempt of before is over
    assert work.finish(job).state == "succeeded"


def test_only_a_failed_job_is_retried(work: Work) -> None:
    queued, done, cancelled = work.fit(), work.fit(), work.fit()
    work.cancel(cancelled)
    with pytest.raises(Conflict, match="is queued; only a failed job can be retried"):
        _retry(work, queued.id)
    work.finish(done)
    for job, state in ((done, "succeeded"), (cancelled, "cancelled")):
        with pytest.raises(Conflict, match=state):
            _retry(work, job.id)
    with pytest.raises(NotFound):
        _retry(work, "job_nothing")
