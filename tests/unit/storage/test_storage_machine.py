"""The state machine against random histories: whatever workers, clocks and people do, the laws hold."""

from __future__ import annotations

import shutil
import tempfile
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    consumes,
    invariant,
    rule,
    run_state_machine_as_test,
)
from sqlalchemy import func, select

from schemas.base import Problem
from schemas.job import TERMINAL_STATES
from storage import jobs, leases
from storage.database import Database
from storage.errors import Conflict
from storage.leases import Lease
from storage.tables import DatasetRow, EpisodeRow, FitRow, JobRow, ShardRow, utc_now

if TYPE_CHECKING:
    from conftest import Work

LEASE_SECONDS = 30.0
ENDED_SHARDS = {"DONE", "FAILED", "CANCELLED"}


class Histories(RuleBasedStateMachine):
    """Two pipelines, a clock that only we move, leases held by workers that may be slow or dead."""

    template: Path
    work_class: type[Work]
    held = Bundle("held")

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="physworld-machine-"))
        path = self.folder / "physworld.db"
        shutil.copy(self.template, path)
        self.database = Database(f"sqlite:///{path}", max_attempts=3)
        self.work = self.work_class(self.database)
        self.pipelines = [self.work.pipeline(episodes=2).id for _ in range(2)]
        self.now: datetime = utc_now() + timedelta(seconds=1)
        self.committed: set[str] = set()
        self.epochs: dict[str, int] = {}
        self.ended: dict[str, str] = {}

    def teardown(self) -> None:
        self.database.dispose()
        shutil.rmtree(self.folder)

    @rule(target=held, choice=st.integers(0, 50), owner=st.sampled_from(["a", "b"]))
    def claim(self, choice: int, owner: str) -> Lease | None:
        return self.claim_one(choice, owner)

    def claim_one(self, choice: int, owner: str) -> Lease | None:
        with self.database.session() as session:
            found = leases.publishable(session, self.now, republish_seconds=1e-9)
            if not found:
                return None
            shard_id = found[choice % len(found)].shard_id
            lease = leases.claim(session, shard_id, owner, self.now, LEASE_SECONDS)
        assert lease is not None
        assert lease.attempt <= 3
        return lease

    @rule(choice=st.integers(0, 50))
    def do_one(self, choice: int) -> None:
        lease = self.claim_one(choice, "quick")
        if lease is not None:
            self.complete_one(lease)

    @rule(lease=held)
    def renew(self, lease: Lease | None) -> None:
        if lease is not None:
            with self.database.session() as session:
                leases.renew(session, lease, self.now, LEASE_SECONDS)

    @rule(lease=held)
    def complete(self, lease: Lease | None) -> None:
        if lease is not None:
            self.complete_one(lease)

    def complete_one(self, lease: Lease) -> None:
        current = self._holds(lease)
        with self.database.session() as session:
            done = leases.complete(session, lease, self.work.result(lease), None)
        assert current or not done
        if done:
            assert lease.shard_id not in self.committed
            self.committed.add(lease.shard_id)

    @rule(lease=consumes(held), retry=st.sampled_from([True, True, True, False]))
    def fail(self, lease: Lease | None, retry: bool) -> None:
        if lease is not None:
            problem = Problem(title="x", status=500, code="x", detail="1 of 2")
            with self.database.session() as session:
                leases.fail(session, lease, problem, retry, self.now)

    @rule(lease=consumes(held))
    def release(self, lease: Lease | None) -> None:
        if lease is not None:
            with self.database.session() as session:
                leases.release(session, lease)

    @rule(lease=held)
    def mark_cancelled_when_told(self, lease: Lease | None) -> None:
        if lease is not None:
            with self.database.session() as session:
                if leases.renew(session, lease, self.now, LEASE_SECONDS) == "cancel":
                    assert leases.mark_cancelled(session, lease)

    @rule(seconds=st.sampled_from([1, 10, 31, 70]))
    def time_passes(self, seconds: int) -> None:
        self.now += timedelta(seconds=seconds)

    @rule(target=held, lease=held)
    def lose_to_another(self, lease: Lease | None) -> Lease | None:
        """The holder falls silent, its lease runs out, and somebody else takes the shard."""
        if lease is None or not self._holds(lease):
            return None
        self.now += timedelta(seconds=LEASE_SECONDS + 1)
        with self.database.session() as session:
            leases.reap(session, self.now)
        with self.database.session() as session:
            return leases.claim(session, lease.shard_id, "another", self.now, LEASE_SECONDS)

    @rule()
    def reap(self) -> None:
        with self.database.session() as session:
            leases.reap(session, self.now)

    @rule(which=st.integers(0, 1), really=st.integers(0, 4))
    def cancel(self, which: int, really: int) -> None:
        if really:
            return
        with self.database.session() as session:
            try:
                jobs.cancel_job(session, self.pipelines[which])
            except Conflict:
                assert session.get_one(JobRow, self.pipelines[which]).state in {"succeeded", "failed"}

    @invariant()
    def epochs_only_grow_and_attempts_are_capped(self) -> None:
        with self.database.reading() as session:
            for shard in session.scalars(select(ShardRow)):
                assert shard.epoch >= self.epochs.get(shard.id, 0)
                assert 0 <= shard.attempt <= min(shard.epoch, 3)
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
        expected = {"succeeded": {"ready", "sealed"}, "failed": {"failed"}, "cancelled": {"failed"}}
        with self.database.reading() as session:
            for row in [*session.scalars(select(FitRow)), *session.scalars(select(DatasetRow))]:
                job = session.get_one(JobRow, row.job_id)
                assert row.state in expected.get(job.state, {"pending", "writing"})

    def _holds(self, lease: Lease) -> bool:
        with self.database.reading() as session:
            shard = session.get_one(ShardRow, lease.shard_id)
            return shard.state == "RUNNING" and shard.epoch == lease.epoch


@pytest.mark.slow
def test_the_laws_hold_in_every_history(sqlite_template: Path, make_work: type[Work]) -> None:
    Histories.template = sqlite_template
    Histories.work_class = make_work
    run_state_machine_as_test(
        Histories,
        settings=settings(
            max_examples=15,
            stateful_step_count=40,
            deadline=None,
            suppress_health_check=[HealthCheck.too_slow],
        ),
    )
