"""Helper shards: pieces of work that a running shard puts up for whoever is free, and takes itself otherwise.

A trace, or a fit, is one long shard that decides, and many simulations that are independent of each other. The shard
that decides (the *driver*) adds the simulations to its own job as helper shards and then works on them like any other
worker. So one worker alone finishes a trace, several share it, and none sits idle holding a lease while another's queue
is full.

A helper shard is under the same leases, caps and cancellation as every other one. It neither counts for its job's stage
nor opens the next one; those of a driver that was lost are called off by its next attempt.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from physworld_schemas import queues
from physworld_schemas.ids import new_id
from physworld_storage.changes import announce
from physworld_storage.database import DEFAULT_MAX_ATTEMPTS, MAX_ATTEMPTS
from physworld_storage.jobs.kind import ShardKind, ShardResult, Tells
from physworld_storage.jobs.shards import CANCELLED, QUEUED, RUNNING, lock_job
from physworld_storage.tables import JobRow, ShardRow, utc_now

if TYPE_CHECKING:
    from physworld_storage.jobs.leases import Lease

SIMULATION = "simulation"


class SimulationResult(ShardResult):
    """Of a ``simulation`` shard: whether the run can be trusted; its tracks are in the scratch."""

    trusted: bool


def _apply(session: Session, job: JobRow, shard: ShardRow, result: SimulationResult) -> None:
    """Nothing: the driver, which waits for the shard, reads its tracks."""


KIND = ShardKind(
    SIMULATION,
    queues.SIMULATION,
    "physworld_workers.tasks.shared_runs:simulate",
    SimulationResult,
    _apply,
    progress=Tells.NOTHING,
    keeps_scratch=True,
    is_helper=True,
)


def put_up(
    session: Session, driver: Lease, first_index: int, payloads: Iterable[dict[str, Any]]
) -> list[str]:
    """Add one simulation to the driver's job for each payload; the shards' ids.

    None when the lease is lost or the job no longer runs (nobody would call off what a cancelled job is given).
    The driver's epoch is the stage, so two attempts never share one.

    Args:
        session: the transaction that they belong to.
        driver: the lease of the shard that waits for them.
        first_index: of the first; it counts on within an attempt.
        payloads: one for each simulation.
    """
    if lock_job(session, driver.job_id).state != "running":
        return []
    held = select(ShardRow.id).where(
        ShardRow.id == driver.shard_id, ShardRow.epoch == driver.epoch, ShardRow.state == RUNNING
    )
    if session.scalar(held) is None:
        return []
    now = utc_now()
    cap = session.info.get(MAX_ATTEMPTS, DEFAULT_MAX_ATTEMPTS)
    shards = [
        ShardRow(
            id=new_id("shard"),
            job_id=driver.job_id,
            stage=driver.epoch,
            index=first_index + number,
            kind=SIMULATION,
            state=QUEUED,
            max_attempts=cap,
            created_at=now,
            payload=payload,
        )
        for number, payload in enumerate(payloads)
    ]
    session.add_all(shards)
    session.flush()
    announce(session)
    return [shard.id for shard in shards]


def states_of(session: Session, shard_ids: Sequence[str]) -> dict[str, str]:
    """States of these shards."""
    rows = session.execute(select(ShardRow.id, ShardRow.state).where(ShardRow.id.in_(shard_ids)))
    return {row.id: row.state for row in rows}


def call_off(session: Session, job_id: str) -> None:
    """Cancel the helpers of a job that nobody waits for any more; one that runs finds its lease lost."""
    session.execute(
        update(ShardRow)
        .where(ShardRow.job_id == job_id, ShardRow.kind == SIMULATION, ShardRow.state.in_((QUEUED, RUNNING)))
        .values(state=CANCELLED, lease_owner=None, lease_until=None, finished_at=utc_now())
    )
