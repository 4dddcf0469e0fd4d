"""What follows what: stages, pipelines, failure and cancellation in both directions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.model import TrainingConfig, TrainingCreate
from physworld_schemas.pipeline import PipelineCreate
from physworld_storage import registry, removal, resources
from physworld_storage.errors import Conflict, NotFound, ResultInvalid
from physworld_storage.jobs import events as log
from physworld_storage.jobs import jobs, leases, shards
from physworld_storage.jobs.kinds.pipeline import model_name_of
from physworld_storage.jobs.shards import STAGE_WINDOW, count_shards

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from conftest import Work

    from physworld_schemas.job import Job


def child_of(work: Work, parent: Job, kind: str) -> Job:
    children = [work.job(child) for child in work.job(parent).children]
    return next(child for child in children if child.kind == kind)


def test_a_pipeline_runs_fit_dataset_training_and_publishes(work: Work) -> None:
    pipeline = work.pipeline(episodes=3)
    kinds = []
    while work.waiting():
        lease = work.claim()
        kinds.append(lease.kind)
        assert work.complete(lease)
    assert kinds == ["fit", "dataset_plan", *["episode"] * 3, "dataset_seal", "training"]
    done = work.job(pipeline)
    assert done.state == "succeeded"
    assert done.progress.done == 100
    assert [output.kind for output in done.outputs] == ["fit", "dataset", "model"]
    assert [work.job(child).kind for child in done.children] == ["fit", "dataset", "training"]
    with work.database.reading() as session:
        fit = resources.get_fit(session, done.outputs[0].id)
        dataset = resources.get_dataset(session, done.outputs[1].id)
        version = registry.get_version(session, "soft-beam", "latest")
    assert (fit.state, dataset.state, version.state) == ("ready", "sealed", "ready")
    assert fit.parameters["youngs_modulus"].ci95 == (1e4, 3e4)
    assert (dataset.episodes_done, dataset.digest) == (3, "c" * 64)
    assert (version.dataset_id, version.fit_id, version.scene_id) == (dataset.id, fit.id, fit.scene_id)
    assert version.sha256 == "e" * 64
    assert done.outputs[2].id == "soft-beam:1"


def _began_from(work: Work, start: str, **sizes: int) -> PipelineCreate:
    settings = TrainingConfig(start_from=start, **sizes)
    return PipelineCreate(
        scene_id=work.scene().id, model_name="other", dataset=DatasetConfig(episodes=1), training=settings
    )


def test_a_pipeline_goes_on_from_a_version_which_stays_until_it_has_ended(work: Work) -> None:
    work.finish(work.pipeline())
    with work.database.session() as session:
        pipeline = jobs.create_pipeline(session, _began_from(work, "soft-beam:latest"))
    with work.database.session() as session, pytest.raises(Conflict, match="needs version 1 of soft-beam"):
        removal.remove_version(session, "soft-beam", 1)
    done = work.finish(pipeline)
    with work.database.session() as session:
        version = registry.get_version(session, "other", 1)
        removal.remove_version(session, "soft-beam", 1)
    assert version.config.start_from == "soft-beam:1"
    training = work.job(next(child for child in done.children if work.job(child).kind == "training"))
    assert ("model", "soft-beam:1", "e" * 64) in {(one.kind, one.id, one.digest) for one in training.inputs}


@pytest.mark.parametrize(
    ("start", "sizes", "error", "says"),
    [
        ("soft-beam:1", {"hidden": 32}, Conflict, "has {'hidden': 48, .* this one has {'hidden': 32"),
        ("soft-beam:2", {}, NotFound, "soft-beam:2"),
        ("unknown:latest", {}, NotFound, "unknown"),
        ("begun:1", {}, Conflict, "begun:1 is pending"),
    ],
)
def test_a_start_that_is_none_is_refused_before_the_fit(
    work: Work, start: str, sizes: dict[str, int], error: type[Exception], says: str
) -> None:
    work.finish(work.pipeline())
    with work.database.session() as session:
        registry.allot_version(session, "begun", config=TrainingConfig())
    with work.database.session() as session, pytest.raises(error, match=says):
        jobs.create_pipeline(session, _began_from(work, start, **sizes))


def test_lineage_names_the_inputs_with_their_digests(work: Work) -> None:
    done = work.finish(work.pipeline())
    with work.database.reading() as session:
        fit = resources.get_fit(session, done.outputs[0].id)
        dataset = resources.get_dataset(session, done.outputs[1].id)
        version = registry.get_version(session, "soft-beam", 1)
        scene = resources.get_scene(session, fit.scene_id)
    assert [(item.kind, item.digest) for item in fit.lineage.inputs] == [("scene", scene.digest)]
    assert [(item.kind, item.digest) for item in dataset.lineage.inputs] == [("fit", "a" * 64)]
    assert [(item.kind, item.digest) for item in version.lineage.inputs] == [("dataset", dataset.digest)]
    assert fit.lineage.job_id == fit.job_id
    assert fit.lineage.seeds == {"main": 1}


def test_progress_of_a_pipeline_never_falls(work: Work) -> None:
    pipeline = work.pipeline(episodes=5)
    work.finish(pipeline)
    with work.database.reading() as session:
        events = log.events_after(session, pipeline.id, 0)
    done = [event.data["done"] for event in events if event.type == "progress"]
    assert done == sorted(done)
    assert done[-1] == 100


def test_events_tell_the_states_in_order_and_can_be_resumed(work: Work) -> None:
    job = work.finish(work.fit())
    with work.database.reading() as session:
        everything = log.events_after(session, job.id, 0)
        resumed = log.events_after(session, job.id, everything[0].seq)
        limited = log.events_after(session, job.id, 0, limit=1)
    assert [event.data["state"] for event in everything if event.type == "state"] == [
        "queued",
        "running",
        "succeeded",
    ]
    assert resumed == everything[1:]
    assert limited == everything[:1]


def test_what_is_not_ready_cannot_be_built_upon(work: Work) -> None:
    fit = work.fit()
    with work.database.session() as session, pytest.raises(Conflict, match="is pending"):
        jobs.create_dataset(session, fit.outputs[0].id, DatasetConfig())
    dataset = work.dataset(episodes=1)
    request = TrainingCreate(name="beam", dataset_id=dataset.outputs[0].id)
    with work.database.session() as session, pytest.raises(Conflict, match="is pending"):
        jobs.create_training(session, request)
    with work.database.session() as session, pytest.raises(NotFound, match="no scene scn_none"):
        jobs.create_fit(session, "scn_none", FitConfig())
    with work.database.session() as session, pytest.raises(NotFound, match="no scene scn_none"):
        jobs.create_pipeline(session, PipelineCreate(scene_id="scn_none"))


def test_a_failed_child_fails_the_pipeline(work: Work) -> None:
    pipeline = work.pipeline()
    work.complete(work.claim())
    work.fail(work.claim(), retry=False, detail="no room")
    child, parent = child_of(work, pipeline, "dataset"), work.job(pipeline)
    assert (child.state, parent.state) == ("failed", "failed")
    assert parent.error is not None
    assert parent.error.detail == f"dataset job {child.id}: no room"
    assert work.waiting() == []


def test_a_failed_episode_calls_off_the_others(work: Work) -> None:
    job = work.dataset(episodes=4)
    work.complete(work.claim())
    done, held, broken = work.claim(), work.claim(), work.claim()
    work.complete(done)
    work.fail(broken, retry=False)
    assert work.job(job).state == "failed"
    assert work.waiting() == []
    assert not work.complete(held)
    with work.database.session() as session:
        assert leases.renew(session, held, 30.0) == "lost"
        dataset = resources.get_dataset(session, job.outputs[0].id)
        assert (dataset.state, dataset.episodes_done) == ("failed", 1)


def test_a_job_that_waits_is_cancelled_at_once_with_what_it_should_have_made(work: Work) -> None:
    job = work.fit()
    assert work.cancel(job).state == "cancelled"
    assert work.waiting() == []
    assert work.cancel(job).state == "cancelled"
    with work.database.reading() as session:
        assert resources.get_fit(session, job.outputs[0].id).state == "cancelled"
        assert [fit.id for fit in resources.list_fits(session, state="cancelled").data] == [job.outputs[0].id]
        assert resources.list_fits(session, state="failed").data == []


def test_running_work_sees_the_cancel_at_its_next_renewal(work: Work) -> None:
    job = work.dataset(episodes=3)
    work.complete(work.claim())
    first, second = work.claim(), work.claim()
    assert work.cancel(job).state == "cancelling"
    assert work.waiting() == []
    with work.database.session() as session:
        assert leases.renew(session, first, 30.0) == "cancel"
        assert leases.mark_cancelled(session, first)
    assert work.job(job).state == "cancelling"
    assert work.complete(second) is False
    assert work.job(job).state == "cancelled"
    with work.database.reading() as session:
        dataset = resources.get_dataset(session, job.outputs[0].id)
        assert (dataset.state, dataset.episodes_done) == ("cancelled", 0)


def test_cancel_goes_down_to_the_child_and_up_to_the_pipeline(work: Work) -> None:
    down, up = work.pipeline(), work.pipeline()
    work.cancel(down)
    assert child_of(work, down, "fit").state == "cancelled"
    assert work.job(down).state == "cancelled"
    work.cancel(child_of(work, up, "fit"))
    assert child_of(work, up, "fit").state == "cancelled"
    assert work.job(up).state == "cancelled"


def test_a_cancelling_pipeline_waits_for_its_running_child(work: Work) -> None:
    pipeline = work.pipeline()
    lease = work.claim()
    assert work.cancel(pipeline).state == "cancelling"
    assert child_of(work, pipeline, "fit").state == "cancelling"
    with work.database.session() as session:
        leases.mark_cancelled(session, lease)
    assert work.job(pipeline).state == "cancelled"
    with work.database.reading() as session:
        states = [event.data for event in log.events_after(session, pipeline.id, 0) if event.type == "state"]
    assert [state["state"] for state in states] == ["queued", "running", "cancelling", "cancelled"]


def test_a_worker_that_dies_while_cancelling_is_reaped_as_cancelled(work: Work) -> None:
    pipeline = work.pipeline()
    lease = work.claim()
    work.cancel(pipeline)
    with work.database.session() as session:
        leases.recover(session)
        assert leases.reap(session) == [lease.shard_id]
    assert work.job(pipeline).state == "cancelled"
    assert work.waiting() == []


def test_a_failure_while_cancelling_is_a_cancellation(work: Work) -> None:
    pipeline = work.pipeline()
    lease = work.claim()
    work.cancel(pipeline)
    assert work.fail(lease, retry=True) == "cancel"
    assert work.job(pipeline).state == "cancelled"


def test_what_has_ended_cannot_be_cancelled(work: Work) -> None:
    job = work.finish(work.fit())
    with work.database.session() as session, pytest.raises(Conflict, match="has succeeded"):
        jobs.cancel_job(session, job.id)
    with work.database.session() as session, pytest.raises(NotFound):
        jobs.cancel_job(session, "job_none")


def test_the_plan_says_how_many_episodes_follow(work: Work) -> None:
    job = work.dataset(episodes=9)
    plan = work.claim()
    with pytest.raises(ResultInvalid, match="episodes"):
        work.complete(plan, episodes=0)
    assert work.complete(plan, episodes=2)
    assert work.job(job).progress.total == 2
    episode = work.claim()
    assert episode.payload["plan"] == {"frames": 10, "particles": 5}
    assert (episode.index, episode.payload["index"]) == (0, 0)


def test_an_episode_must_carry_the_index_of_its_shard(work: Work) -> None:
    work.dataset(episodes=2)
    work.complete(work.claim())
    lease = work.claim()
    with pytest.raises(ResultInvalid, match="carries index 1, its shard is number 0"):
        work.complete(lease, index=1)


def test_versions_are_allotted_without_gaps_and_never_twice(work: Work) -> None:
    first, second = work.pipeline(), work.pipeline()
    for pipeline in (first, second):
        work.finish(pipeline)
    with work.database.reading() as session:
        versions = registry.list_versions(session, "soft-beam").data
    assert [version.version for version in versions] == [2, 1]


def test_a_cancelled_training_leaves_a_cancelled_version(work: Work) -> None:
    pipeline = work.pipeline(episodes=1)
    for _ in range(4):
        work.complete(work.claim())
    assert child_of(work, pipeline, "training").state == "queued"
    work.cancel(pipeline)
    with work.database.reading() as session:
        version = registry.get_version(session, "soft-beam", 1)
    assert (version.state, version.message) == ("cancelled", "")


def test_jobs_are_listed_newest_first_in_pages(work: Work) -> None:
    made = [work.fit() for _ in range(5)]
    work.pipeline()
    with work.database.reading() as session:
        first = jobs.list_jobs(session, limit=3, kind="fit")
        second = jobs.list_jobs(session, limit=3, kind="fit", cursor=first.next_cursor)
    found = [job.id for job in first.data + second.data]
    assert found[1:] == [job.id for job in reversed(made)]
    assert (first.has_more, second.has_more, second.next_cursor) == (True, False, None)


@pytest.mark.parametrize(
    ("scene", "model"),
    [("Beam, free (A)", "beam-free-a"), ("...", "model"), ("Ärmel", "rmel"), ("x" * 80, "x" * 64)],
)
def test_a_scenes_name_becomes_a_valid_model_name(scene: str, model: str) -> None:
    assert model_name_of(scene) == model
    TrainingCreate(name=model_name_of(scene), dataset_id="dst_x")


def test_a_stage_of_twenty_thousand_shards_is_opened_by_one_short_transaction(work: Work) -> None:
    dataset = work.dataset(episodes=20_000)
    work.complete(work.claim())
    opened = work.job(dataset)
    assert (opened.progress.done, opened.progress.total) == (0, 20_000)
    assert len(work.waiting()) == STAGE_WINDOW
    with work.database.reading() as session:
        assert count_shards(session)["episode", "QUEUED"] == 20_000


def test_the_shards_of_a_stage_are_made_as_it_goes_on_and_none_is_left_out(
    work: Work, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shards, "STAGE_WINDOW", 4)
    dataset = work.dataset(episodes=11)
    work.complete(work.claim())
    taken, most = [], 0
    while work.job(dataset).progress.done < 11:
        most = max(most, len(work.waiting()))
        lease = work.claim()
        taken.append(lease.index)
        work.complete(lease)
    assert taken == list(range(11))
    assert most == 4
    assert work.finish(dataset).state == "succeeded"


def test_a_stage_goes_on_when_its_shards_end_in_another_order(
    work: Work, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shards, "STAGE_WINDOW", 4)
    dataset = work.dataset(episodes=10)
    work.complete(work.claim())
    while work.job(dataset).progress.done < 10:
        for lease in reversed([work.claim(shard) for shard in work.waiting()]):
            work.complete(lease)
    with work.database.reading() as session:
        episodes = resources.all_episodes(session, dataset.outputs[0].id)
    assert [episode.index for episode in episodes] == list(range(10))


def test_a_cancelled_stage_makes_no_more_shards(work: Work, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "STAGE_WINDOW", 4)
    dataset = work.dataset(episodes=10)
    work.complete(work.claim())
    lease = work.claim()
    work.cancel(dataset)
    assert not work.complete(lease)
    assert work.waiting() == []
    assert work.job(dataset).state == "cancelled"
