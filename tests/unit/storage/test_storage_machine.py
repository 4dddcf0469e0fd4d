"""The state machine against random histories: whatever workers, clocks and people do, the laws hold."""

from __future__ import annotations

import shutil
import tempfile
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    MultipleResults,
    RuleBasedStateMachine,
    consumes,
    invariant,
    multiple,
    precondition,
    rule,
    run_state_machine_as_test,
)
from sqlalchemy import func, select

from physworld_schemas.base import Problem
from physworld_schemas.job import TERMINAL_STATES
from physworld_storage.database import Database
from physworld_storage.errors import Conflict
from physworld_storage.jobs import jobs, leases
from physworld_storage.jobs.leases import Lease
from physworld_storage.tables import DatasetRow, EpisodeRow, FitRow, JobRow, ShardRow, utc_now

if TYPE_CHECKING:
    from conftest import Work

LEASE_SECONDS = 30.0
MAX_ATTEMPTS = 3
CHOICE = st.integers(0, 50)
ENDED_SHARDS = {"DONE", "FAILED", "CANCELLED"}


class Histories(RuleBasedStateMachine):
    """Some pipelines, a clock that only we move, leases held by workers that may be slow or dead."""

    template: Path
    work_class: type[Work]
    held = Bundle("held")

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="physworld-machine-"))
        path = self.folder / "physworld.db"
        shutil.copy(self.template, path)
        self.now: datetime = utc_now() + timedelta(seconds=1)
        self.database = Database(f"sqlite:///{path}", max_attempts=MAX_ATTEMPTS, clock=lambda: self.now)
        self.work = self.work_class(self.database)
        self.pipelines = [self.work.pipeline(episodes=2).id for _ in range(2)]
        self.committed: set[str] = set()
        self.epochs: dict[str, int] = {}
        self.ended: dict[str, str] = {}

    def teardown(self) -> None:
        self.database.dispose()
        shutil.rmtree(self.folder)

    @rule(target=held, choice=CHOICE, owner=st.sampled_from(["a", "b"]))
    def claim(self, choice: int, owner: str) -> Lease | MultipleResults[Lease]:
        return self._claim_any(choice, owner) or multiple()

    @rule(choice=CHOICE)
    def do_one(self, choice: int) -> None:
        lease = self._claim_any(choice, "quick")
        if lease is not None:
            assert self._complete(lease)

    @rule(lease=held)
    def renew(self, lease: Lease) -> None:
        holds = self._holds(lease)
        with self.database.session() as session:
            assert (leases.renew(session, lease, LEASE_SECONDS) != "lost") == holds

    @rule(lease=held)
    def complete(self, lease: Lease) -> None:
        self._complete(lease)

    @rule(lease=consumes(held), retry=st.sampled_from([True, True, True, True, False]))
    def fail(self, lease: Lease, retry: bool) -> None:
        holds = self._holds(lease)
        problem = Problem(title="x", status=500, code="x", detail="1 of 2")
        with self.database.session() as session:
            assert (leases.fail(session, lease, problem, retry) != "lost") == holds

    @rule(lease=consumes(held))
    def release(self, lease: Lease) -> None:
        holds = self._holds(lease)
        with self.database.session() as session:
            assert leases.release(session, lease) == holds

    @rule(lease=held)
    def stop_when_told(self, lease: Lease) -> None:
        with self.database.session() as session:
            if leases.renew(session, lease, LEASE_SECONDS) == "cancel":
                assert leases.mark_cancelled(session, lease)

    @rule(target=held, lease=held, act=st.sampled_from(["complete", "fail", "release", "renew"]))
    def come_back_late(self, lease: Lease, act: str) -> Lease | MultipleResults[Lease]:
        """The holder falls silent, somebody else takes the shard, then the first one wakes up."""
        if not self._holds(lease):
            return multiple()
        self.now += timedelta(seconds=LEASE_SECONDS + 1)
        with self.database.session() as session:
            leases.reap(session)
        with self.database.session() as session:
            other = leases.claim(session, lease.shard_id, "another", LEASE_SECONDS)
        if act == "complete":
            assert not self._complete(lease)
        elif act == "fail":
            self.fail(lease, retry=False)
        elif act == "release":
            self.release(lease)
        else:
            self.renew(lease)
        return other or multiple()

    @rule(lease=held, choice=CHOICE)
    def finish_although_cancelled(self, lease: Lease, choice: int) -> None:
        if choice % 3 or not self._holds(lease):
            return
        with self.database.session() as session:
            jobs.cancel_job(session, lease.job_id)
        assert not self._complete(lease)

    @rule(seconds=st.sampled_from([1, 10, 31, 70]), reap=st.booleans())
    def time_passes(self, seconds: int, reap: bool) -> None:
        self.now += timedelta(seconds=seconds)
        if reap:
            with self.database.session() as session:
                leases.reap(session)

    @rule(choice=CHOICE)
    def cancel(self, choice: int) -> None:
        if choice % 3:
            return
        job_id = self.pipelines[choice % len(self.pipelines)]
        with self.database.session() as session:
            try:
                jobs.cancel_job(session, job_id)
            except Conflict:
                assert session.get_one(JobRow, job_id).state in {"succeeded", "failed"}

    @rule(choice=CHOICE)
    def retry(self, choice: int) -> None:
        """What failed is taken up again with its family; what succeeded or was cancelled stays ended."""
        job_id = self.pipelines[choice % len(self.pipelines)]
        with self.database.session() as session:
            state = session.get_one(JobRow, job_id).state
            try:
                jobs.retry_job(session, job_id)
            except Conflict:
                assert state != "failed"
                return
            assert state == "failed"
        self.ended = {
            ended: state
            for ended, state in self.ended.items()
            if state != "failed" or not self._of(ended, job_id)
        }

    @precondition(lambda self: len(self.ended_pipelines()) > len(self.pipelines) - 2)
    @rule()
    def open_another(self) -> None:
        self.pipelines.append(self.work.pipeline(episodes=2).id)

    @invariant()
    def epochs_only_grow_and_failures_are_capped(self) -> None:
        with self.database.reading() as session:
            for shard in session.scalars(select(ShardRow)):
                assert shard.epoch >= self.epochs.get(shard.id, 0)
                assert 0 <= shard.failures <= min(shard.attempt, MAX_ATTEMPTS)
                assert shard.attempt <= shard.epoch
                assert (shard.lease_until is not None) == (shard.state == "RUNNING")
                self.epochs[shard.id] = shard.epoch

    @invariant()
    def a_job_and_its_shards_agree(self) -> None:
        with self.database.reading() as session:
            for job in session.scalars(select(JobRow).where(JobRow.kind != "pipeline")):
                shards = session.scalars(select(ShardRow).where(ShardRow.job_id == job.id)).all()
                stage = [shard.state for shard in shards if shard.stage == job.stage]
                assert job.stage_total == len(stage)
                assert job.stage_done == stage.count("DONE")
                if job.state in TERMINAL_STATES:
                    assert {shard.state for shard in shards} <= ENDED_SHARDS
                else:
                    assert not {shard.state for shard in shards} <= ENDED_SHARDS
                assert (job.state == "succeeded") <= all(shard.state == "DONE" for shard in shards)

    @invariant()
    def a_pipeline_and_its_children_agree(self) -> None:
        with self.database.reading() as session:
            for parent in session.scalars(select(JobRow).where(JobRow.kind == "pipeline")):
                children = session.scalars(
                    select(JobRow).where(JobRow.parent_id == parent.id).order_by(JobRow.created_at)
                ).all()
                kinds = [child.kind for child in children]
                assert kinds == ["fit", "dataset", "training"][: len(kinds)]
                active = [child for child in children if child.state not in TERMINAL_STATES]
                assert len(active) == (parent.state not in TERMINAL_STATES)
                assert {child.state for child in children[:-1]} <= {"succeeded"}
                if parent.state != "queued":
                    assert children[-1].state == parent.state or not {"queued", "running"}.isdisjoint(
                        {parent.state, children[-1].state}
                    )

    @invariant()
    def ended_jobs_stay_as_they_are(self) -> None:
        with self.database.reading() as session:
            for job in session.scalars(select(JobRow)):
                if job.id in self.ended:
                    assert job.state == self.ended[job.id]
                elif job.state in TERMINAL_STATES:
                    assert job.finished_at is not None
                    self.ended[job.id] = job.state

    @invariant()
    def committed_episodes_are_the_done_shards(self) -> None:
        with self.database.reading() as session:
            episodes = set(session.scalars(select(EpisodeRow.shard_id)))
            done = select(ShardRow.id).where(ShardRow.kind == "episode", ShardRow.state == "DONE")
            assert episodes == set(session.scalars(done))
            for dataset in session.scalars(select(DatasetRow)):
                count = select(func.count()).where(EpisodeRow.dataset_id == dataset.id)
                assert session.scalar(count) == dataset.episodes_done

    @invariant()
    def resources_follow_their_jobs(self) -> None:
        expected = {"succeeded": {"ready", "sealed"}, "failed": {"failed"}, "cancelled": {"cancelled"}}
        with self.database.reading() as session:
            for row in [*session.scalars(select(FitRow)), *session.scalars(select(DatasetRow))]:
                job = session.get_one(JobRow, row.job_id)
                assert row.state in expected.get(job.state, {"pending", "writing"})

    def ended_pipelines(self) -> list[str]:
        return [job_id for job_id in self.pipelines if job_id in self.ended]

    def _of(self, job_id: str, root: str) -> bool:
        with self.database.reading() as session:
            return root in {job_id, session.get_one(JobRow, job_id).parent_id}

    def _claim_any(self, choice: int, owner: str) -> Lease | None:
        with self.database.session() as session:
            found = leases.publishable(session, republish_seconds=1e-9)
            if not found:
                return None
            shard_id = found[choice % len(found)].shard_id
            lease = leases.claim(session, shard_id, owner, LEASE_SECONDS)
        assert lease is not None
        return lease

    def _complete(self, lease: Lease) -> bool:
        holds = self._holds(lease)
        cancelling = self._job_of(lease).state == "cancelling"
        with self.database.session() as session:
            done = leases.complete(session, lease, self.work.result(lease), None)
        assert done == (holds and not cancelling)
        if done:
            assert lease.shard_id not in self.committed
            self.committed.add(lease.shard_id)
        return done

    def _holds(self, lease: Lease) -> bool:
        with self.database.reading() as session:
            shard = session.get_one(ShardRow, lease.shard_id)
            return shard.state == "RUNNING" and shard.epoch == lease.epoch

    def _job_of(self, lease: Lease) -> JobRow:
        with self.database.reading() as session:
            return session.get_one(JobRow, lease.job_id)


@pytest.mark.slow
def test_the_laws_hold_in_every_history(sqlite_template: Path, make_work: type[Work]) -> None:
    Histories.template = sqlite_template
    Histories.work_class = make_work
    run_state_machine_as_test(
        Histories,
        settings=settings(
            max_examples=20,
            stateful_step_count=50,
            deadline=None,
            derandomize=True,
            phases=[Phase.generate],  # ids hold the time of day, so a history cannot be shrunk faithfully
            suppress_health_check=[HealthCheck.too_slow],
        ),
    )
