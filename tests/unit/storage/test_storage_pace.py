"""The time left that jobs tell: by how earlier ones of their kind went, without any by their fraction."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import event, text

from physworld_schemas.dataset import DatasetConfig
from physworld_schemas.fit import FitConfig
from physworld_schemas.job import Job, Progress
from physworld_schemas.pipeline import PipelineCreate
from physworld_storage.database import Database
from physworld_storage.jobs import jobs, leases, pace
from physworld_storage.jobs.leases import Lease
from physworld_storage.jobs.progress import longest_share, share_of_time
from physworld_storage.tables import JobRow

pytestmark = pytest.mark.slow

LEASE_SECONDS = 30.0
EARLY = ((0.1, 4.0), (0.3, 12.0), (0.8, 16.0), (0.9, 18.0))
"""A fit whose search ends long before its budget: at 0.3 after 12 of 20 s, then measures."""


class Hours:
    """A worker and a client in one, whose database has a clock of its own, which passes when told to."""

    def __init__(self, url: str, work: Any) -> None:
        self.now = datetime(2026, 1, 1, tzinfo=UTC)
        self.database = Database(url, clock=lambda: self.now)
        self.work = work(self.database)

    def sleep(self, seconds: float) -> None:
        self.now += timedelta(seconds=seconds)

    def fit(self, scene_id: str | None = None, **changes: Any) -> Job:
        """A fit, of a scene of its own unless one is named."""
        with self.database.session() as session:
            return jobs.create_fit(session, scene_id or self.work.scene().id, FitConfig(**changes))

    def pipeline(self, **changes: Any) -> Job:
        scene = self.work.scene()
        request = PipelineCreate(scene_id=scene.id, dataset=DatasetConfig(episodes=10), **changes)
        with self.database.session() as session:
            return jobs.create_pipeline(session, request)

    def tell(self, lease: Lease, fraction: float) -> None:
        with self.database.session() as session:
            told = Progress(done=fraction, total=1.0, fraction=fraction)
            assert leases.renew(session, lease, LEASE_SECONDS, told) == "held"

    def run(
        self, lease: Lease, course: tuple[tuple[float, float], ...], lasts_s: float, step_s: float = 1.0
    ) -> None:
        """Do a shard that comes to fractions at these times, with a word every step; then hand it back."""
        began = self.now
        for fraction, at_s in (*course, (None, lasts_s)):
            until = began + timedelta(seconds=at_s)
            while self.now + timedelta(seconds=step_s) < until:
                self.sleep(step_s)
                with self.database.session() as session:
                    leases.renew(session, lease, LEASE_SECONDS)
            self.now = until
            if fraction is not None:
                self.tell(lease, fraction)
        assert self.work.complete(lease)

    def left_s(self, job: Job) -> float | None:
        return self.work.job(job).progress.eta_s

    def pace(self, job: Job) -> dict[str, Any] | None:
        with self.database.reading() as session:
            return session.get_one(JobRow, job.id).pace


@pytest.fixture
def hours(database_url: str, make_work: Callable[[Database], Any]) -> Iterator[Hours]:
    """A service with a clock of its own."""
    opened = Hours(database_url, make_work)
    yield opened
    opened.database.dispose()


def test_a_share_of_time_is_read_off_a_course() -> None:
    course = [[0.2, 0.5], [0.8, 0.6]]
    shares = [share_of_time(course, fraction) for fraction in (0.0, 0.1, 0.2, 0.5, 0.8, 0.9, 1.0)]
    assert shares == pytest.approx([0.0, 0.25, 0.5, 0.55, 0.6, 0.8, 1.0])
    assert [longest_share(course, fraction) for fraction in (0.1, 0.2, 0.8)] == [0.5, 0.6, 1.0]
    assert share_of_time([[1.0, 0.7]], 1.0) == 0.7  # what came after the last word


def test_a_job_that_succeeds_keeps_its_course(hours: Hours) -> None:
    job = hours.fit()
    hours.run(hours.work.claim(), EARLY, 20.0)
    assert hours.pace(job) == {
        "of": [job.inputs[0].id],
        "lasted_s": 20.0, "course": [[0.1, 0.2], [0.3, 0.6], [0.8, 0.8], [0.9, 0.9]],
    }  # fmt: skip


def test_the_first_of_its_kind_goes_by_its_fraction(hours: Hours) -> None:
    job = hours.fit()
    lease = hours.work.claim()
    hours.sleep(1.0)
    hours.tell(lease, 0.3)
    assert hours.left_s(job) is None  # too early
    hours.sleep(8.0)
    hours.tell(lease, 0.3)
    assert hours.left_s(job) == pytest.approx(9.0 * 0.7 / 0.3, abs=0.1)


def test_the_next_goes_as_the_one_before_went(hours: Hours) -> None:
    hours.fit()
    hours.run(hours.work.claim(), EARLY, 20.0)
    job = hours.fit()
    lease = hours.work.claim()
    hours.sleep(8.0)  # twice as slow as the one before
    hours.tell(lease, 0.1)
    assert hours.left_s(job) == pytest.approx(32.0)
    hours.sleep(16.0)
    hours.tell(lease, 0.3)
    assert hours.left_s(job) == pytest.approx(16.0)


def test_what_is_asked_again_is_known_from_the_first_word(hours: Hours) -> None:
    scene = hours.work.scene()
    hours.fit(scene.id)
    hours.run(hours.work.claim(), EARLY, 20.0)
    job = hours.fit(scene.id)
    lease = hours.work.claim()
    left = []
    for seconds, fraction in ((0.5, 0.0), (7.5, 0.1), (16.0, 0.3)):  # twice as slow as the one before
        hours.sleep(seconds)
        hours.tell(lease, fraction)
        left.append(hours.left_s(job))
    wholes = [
        (worked + 0.5 * 20.0) / (share + 0.5) for worked, share in ((0.5, 0.0), (8.0, 0.2), (24.0, 0.6))
    ]
    assert left == pytest.approx([wholes[0], 0.8 * wholes[1], 0.4 * wholes[2]], abs=0.1)


def test_a_dataset_of_another_fit_of_the_same_recording_is_the_same_again(hours: Hours) -> None:
    scene = hours.work.scene()
    whole_s = []
    for scene_id in (scene.id, scene.id, hours.work.scene().id):
        fit = hours.work.finish(hours.fit(scene_id))
        with hours.database.session() as session:
            job = jobs.create_dataset(session, fit.outputs[0].id, DatasetConfig(episodes=2))
        lease = hours.work.claim()
        found = hours.pace(job)
        assert found is not None and found["of"] == [scene_id]
        whole_s.append(found["whole_s"])
        hours.run(lease, (), 4.0)
        hours.work.finish(job)
    assert whole_s == [None, 4.0, None]


def test_the_time_left_goes_on_where_the_fraction_stands_still(hours: Hours) -> None:
    hours.fit()
    hours.run(hours.work.claim(), EARLY, 20.0)
    job = hours.fit()
    lease = hours.work.claim()
    left = []
    for seconds in (12.0, 2.0, 2.0, 8.0):
        hours.sleep(seconds)
        hours.tell(lease, 0.3)
        left.append(hours.left_s(job))
    assert left == pytest.approx([8.0, 6.0, 4.0, 6.0])  # at last later than ever: at most 0.8 of it is over


def test_of_several_the_median_of_the_last_that_were_asked_for_the_like(hours: Hours) -> None:
    for lasts_s in (20.0, 16.0, 40.0):
        hours.fit(max_simulations=50)
        hours.run(hours.work.claim(), ((0.5, 10.0),), lasts_s)
    hours.fit(max_simulations=60)
    hours.run(hours.work.claim(), ((0.5, 10.0),), 11.0)
    alike, other = hours.fit(max_simulations=50), hours.fit(max_simulations=60)
    for job, left_s in ((alike, 10.0), (other, 1.0)):
        lease = hours.work.claim()
        hours.sleep(10.0)
        hours.tell(lease, 0.5)
        assert hours.left_s(job) == pytest.approx(left_s, abs=0.1)


def test_what_was_cancelled_or_begun_anew_is_no_example(hours: Hours) -> None:
    cancelled, lost, failed = hours.fit(), hours.fit(), hours.fit()
    lease = hours.work.claim()
    hours.sleep(5.0)
    hours.tell(lease, 0.5)
    hours.work.cancel(cancelled)
    with hours.database.session() as session:
        assert leases.mark_cancelled(session, lease)
    hours.work.claim()
    hours.sleep(LEASE_SECONDS + 1)
    with hours.database.session() as session:
        leases.reap(session)
    hours.run(hours.work.claim(), EARLY, 20.0)
    hours.work.fail(hours.work.claim(), retry=False)
    with hours.database.session() as session:
        jobs.retry_job(session, failed.id)
    hours.run(hours.work.claim(), EARLY, 20.0)
    assert [hours.work.job(job).state for job in (cancelled, lost, failed)] == [
        "cancelled",
        *["succeeded"] * 2,
    ]
    job = hours.fit()
    assert [hours.pace(job) for job in (lost, failed)] == [None, None]
    hours.work.claim()
    begun = hours.pace(job)
    assert begun is not None and begun["course"] == []


def test_a_pause_is_no_work(hours: Hours) -> None:
    job = hours.fit()
    lease = hours.work.claim()
    hours.sleep(10.0)
    hours.tell(lease, 0.5)
    with hours.database.session() as session:
        assert leases.release(session, lease)  # the service is stopped for the night
    hours.sleep(36_000.0)
    lease = hours.work.claim()
    hours.sleep(4.0)
    hours.tell(lease, 0.7)
    assert hours.left_s(job) == pytest.approx(14.0 * 0.3 / 0.7, abs=0.1)


def test_a_retried_job_counts_what_it_had_worked_before(hours: Hours) -> None:
    job = hours.fit()
    lease = hours.work.claim()
    hours.sleep(10.0)
    hours.tell(lease, 0.5)
    hours.work.fail(lease, retry=False)
    hours.sleep(36_000.0)
    with hours.database.session() as session:
        jobs.retry_job(session, job.id)
    lease = hours.work.claim()
    hours.sleep(5.0)
    hours.tell(lease, 0.75)  # it goes on from where it was
    assert hours.left_s(job) == pytest.approx(5.0)


def test_a_first_pipeline_tells_what_is_left_of_its_child_and_the_others(hours: Hours) -> None:
    pipeline = hours.pipeline()
    with hours.database.reading() as session:
        row = session.get_one(JobRow, pipeline.id)
        usual = {kind: pace.KINDS[kind].seconds(config) for kind, config in pace.kind_of(row).chain(row, ())}
    lease = hours.work.claim()
    hours.sleep(10.0)
    hours.tell(lease, 0.02)
    assert hours.left_s(pipeline) is None  # too early
    hours.tell(lease, 0.25)  # a fit of 40 s
    expected = 30.0 + (usual["dataset"] + usual["training"]) * 40.0 / usual["fit"]
    assert hours.left_s(pipeline) == pytest.approx(expected, rel=0.01)
    hours.sleep(10.0)
    assert hours.work.complete(lease)  # ... which was one of 20 s
    expected = (usual["dataset"] + usual["training"]) * 20.0 / usual["fit"]
    assert hours.left_s(pipeline) == pytest.approx(expected, rel=0.01)
    lease = hours.work.claim()
    hours.sleep(3.0)
    assert hours.work.complete(lease)  # the dataset is planned, a tenth of its time
    expected = 27.0 + usual["training"] * 20.0 / usual["fit"]
    assert hours.left_s(pipeline) == pytest.approx(expected, rel=0.01)


def test_a_first_pipeline_knows_how_long_single_jobs_took(hours: Hours) -> None:
    hours.fit()
    hours.run(hours.work.claim(), EARLY, 20.0)
    single = hours.work.dataset(episodes=10)
    while hours.work.job(single).state != "succeeded":
        lease = hours.work.claim()
        hours.sleep(2.0)
        assert hours.work.complete(lease)
    pipeline = hours.pipeline()
    lease = hours.work.claim()
    hours.sleep(12.0)
    hours.tell(lease, 0.3)
    found = hours.pace(pipeline)
    assert found is not None and found["children"]["dataset"] == pytest.approx(24.0)
    with hours.database.reading() as session:
        row = session.get_one(JobRow, pipeline.id)
        config = dict(pace.kind_of(row).chain(row, ()))["training"]
    training_s = pace.KINDS["training"].seconds(config) * 20.0 / pace.KINDS["fit"].seconds(row.config["fit"])
    assert hours.left_s(pipeline) == pytest.approx(8.0 + 24.0 + training_s, rel=0.01)


def test_the_next_pipeline_goes_as_the_one_before_went_and_none_with_a_trace_does(hours: Hours) -> None:
    def finish(pipeline: Job, each_s: float) -> list[tuple[datetime, float | None]]:
        told = []
        while hours.work.job(pipeline).state != "succeeded":
            lease = hours.work.claim()
            hours.sleep(each_s)
            assert hours.work.complete(lease)
            told.append((hours.now, hours.left_s(pipeline)))
        return told

    finish(hours.pipeline(), 3.0)
    told = finish(hours.pipeline(), 6.0)
    ended = told[-1][0]
    for at, left_s in told[1:-1]:
        assert left_s == pytest.approx((ended - at).total_seconds(), rel=0.15, abs=1.0)
    traced = hours.pipeline(close_the_loop=True)
    hours.work.claim()
    found = hours.pace(traced)
    assert (
        found is not None
        and found["course"] == []
        and set(found["children"]) == {"fit", "dataset", "training"}
    )


def test_a_word_reads_no_events_and_the_course_needs_none(hours: Hours) -> None:
    job = hours.fit()
    lease = hours.work.claim()
    statements: list[str] = []

    def note(connection: Any, cursor: Any, statement: str, *rest: Any) -> None:
        statements.append(statement)

    event.listen(hours.database.engine, "before_cursor_execute", note)
    for _ in range(3):
        hours.sleep(4.0)
        hours.tell(lease, 0.3)
    event.remove(hours.database.engine, "before_cursor_execute", note)
    assert not [statement for statement in statements if "FROM events" in statement]
    with hours.database.session() as session:
        session.execute(text("DELETE FROM events"))
    assert hours.work.complete(lease)
    assert hours.pace(job) == {
        "of": [job.inputs[0].id],
        "lasted_s": 12.0,
        "course": [[0.3, pytest.approx(1 / 3, abs=1e-3)]],
    }
