"""A training that may begin while its dataset is being written: when it is opened, and what ends the pipeline."""

from __future__ import annotations

from datetime import timedelta
from typing import TYPE_CHECKING

import pytest

from physworld_schemas.base import Problem
from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.job import Job
from physworld_schemas.model import TrainingConfig, TrainingCreate
from physworld_schemas.pipeline import PipelineCreate
from physworld_storage import registry
from physworld_storage.errors import Conflict
from physworld_storage.jobs import jobs, leases
from physworld_storage.tables import JobRow, ShardRow

if TYPE_CHECKING:
    from conftest import Work

EPISODES = 3
STREAMED = TrainingConfig(start_share=0.5)


def pipeline(work: Work, training: TrainingConfig = STREAMED) -> Job:
    """A pipeline whose fit and plan are done."""
    with work.database.session() as session:
        body = PipelineCreate(
            scene_id=work.scene().id, dataset=DatasetConfig(episodes=EPISODES), training=training
        )
        job = jobs.create_pipeline(session, body)
    for _ in range(2):
        assert work.complete(work.claim())
    return work.job(job)


def kinds(work: Work, parent: Job) -> dict[str, str]:
    """Kind to state of a pipeline's children."""
    return {(job := work.job(child)).kind: job.state for child in work.job(parent).children}


def waiting(work: Work, kind: str) -> list[str]:
    """Shards of that kind that wait."""
    with work.database.reading() as session:
        return [shard for shard in work.waiting() if session.get_one(ShardRow, shard).kind == kind]


def test_the_training_opens_with_the_plan_and_the_pipeline_waits_for_both(work: Work) -> None:
    job = pipeline(work)
    assert kinds(work, job) == {"fit": "succeeded", "dataset": "running", "training": "queued"}
    training = work.claim(waiting(work, "training")[0])
    for _ in range(EPISODES + 1):
        assert work.complete(work.claim([*waiting(work, "episode"), *waiting(work, "dataset_seal")][0]))
    assert kinds(work, job) == {"fit": "succeeded", "dataset": "succeeded", "training": "running"}
    assert work.job(job).state == "running"
    assert work.complete(training)
    done = work.job(job)
    assert done.state == "succeeded"
    assert [output.kind for output in done.outputs] == ["fit", "dataset", "model"]


def test_a_host_whose_clock_is_behind_opens_no_second_training(work: Work) -> None:
    job = pipeline(work)
    with work.database.session() as session:
        beside = session.query(JobRow).where(JobRow.parent_id == job.id, JobRow.kind == "training").one()
        beside.created_at -= timedelta(seconds=2)  # as if made before its dataset was
    done = work.finish(job)
    assert done.state == "succeeded"
    assert [work.job(child).kind for child in done.children].count("training") == 1
    assert [output.kind for output in done.outputs].count("model") == 1


def test_without_a_share_the_training_waits_for_the_seal(work: Work) -> None:
    job = pipeline(work, TrainingConfig())
    assert kinds(work, job) == {"fit": "succeeded", "dataset": "running"}


def test_a_training_that_fails_beside_its_dataset_fails_the_pipeline_for_good(work: Work) -> None:
    job = pipeline(work)
    training = work.claim(waiting(work, "training")[0])
    with work.database.session() as session:
        problem = Problem(title="Diverged", status=422, code="training_diverged", detail="loss nan")
        leases.fail(session, training, problem, retry=False)
    assert work.job(job).state == "failed"
    while work.waiting():
        assert work.complete(work.claim())
    assert kinds(work, job) == {"fit": "succeeded", "dataset": "succeeded", "training": "failed"}
    assert work.job(job).state == "failed"


def test_a_cancel_reaches_both(work: Work) -> None:
    job = pipeline(work)
    work.cancel(job)
    assert kinds(work, job) == {"fit": "succeeded", "dataset": "cancelled", "training": "cancelled"}
    assert work.job(job).state == "cancelled"


def test_a_training_on_a_dataset_in_the_making_needs_a_share(work: Work) -> None:
    made = work.dataset(EPISODES)
    dataset_id = made.outputs[0].id
    with (
        work.database.session() as session,
        pytest.raises(Conflict, match="pending; training needs a sealed"),
    ):
        jobs.create_training(session, TrainingCreate(name="beam", dataset_id=dataset_id))
    with work.database.session() as session:
        jobs.create_training(session, TrainingCreate(name="beam", dataset_id=dataset_id, config=STREAMED))
    with work.database.reading() as session:
        assert registry.get_version(session, "beam", 1).dataset_id == dataset_id
    work.cancel(made)
    with (
        work.database.session() as session,
        pytest.raises(Conflict, match="cancelled; training needs one that is"),
    ):
        jobs.create_training(session, TrainingCreate(name="beam", dataset_id=dataset_id, config=STREAMED))
