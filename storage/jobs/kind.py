"""What a kind of job is: the class that each file of ``physworld_storage.jobs.kinds`` makes one object of.

A ``JobKind`` says how a job of it is opened (``open``, with arguments of its own), fails, and is taken up again; and
of which shards it consists. A ``ShardKind`` says on which queue a shard of it waits, which function of a worker does
it, what that hands back, how the result is applied, which stage follows, and what its progress means for the job.

Everything of one job is made in the caller's transaction, so a job without a shard or a shard without a job
cannot be seen by anybody.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar, Generic, TypeVar

from pydantic import Field
from sqlalchemy.orm import Session

from physworld_schemas.base import Lineage, Reference, Resource, Unmade
from physworld_schemas.ids import new_id
from physworld_schemas.job import Job, Progress
from physworld_schemas.job import JobKind as Name
from physworld_storage.jobs.events import append_event
from physworld_storage.jobs.shards import Stage, put_up
from physworld_storage.rows import end_pending, required
from physworld_storage.tables import JobRow, Made, ShardRow, utc_now


class ShardResult(Resource):
    """Common part of what every shard hands back."""

    lineage: Lineage = Field(default_factory=Lineage)

    def fault_at(self, index: int) -> str | None:
        """Why this cannot be the result of shard ``index`` of its stage, if so."""
        return None


Result = TypeVar("Result", bound=ShardResult)


class Tells(Enum):
    """What a shard's progress means for its job."""

    ITS_OWN = "the shard is alone in its stage: its progress is the job's"
    SHARDS_DONE = "the job's progress is how many shards of the stage are done"
    NOTHING = "too short to tell"


@dataclass(frozen=True)
class ShardKind(Generic[Result]):
    """One kind of shard.

    Attributes:
        name: as in the database.
        queue: one of ``physworld_schemas.queues``.
        handler: ``module:function`` of the workers or of a service, imported when the first shard arrives.
        result: what the handler's result is parsed as.
        apply: stores a result, in the transaction that commits the shard.
        next: the stage that follows when the last shard of this stage has ended with this result.
        progress: what the shard's progress means for its job.
        keeps_scratch: whether its job keeps files in the scratch store.
        is_helper: put up by another shard, which waits for it: it neither counts for its stage nor ends it.
        span: the part of the job's time that its stage covers, about: where it begins and ends, 0 to 1.
    """

    name: str
    queue: str
    handler: str
    result: type[Result]
    apply: Callable[[Session, JobRow, ShardRow, Result], None]
    next: Callable[[ShardRow, Result], Stage] | None = None
    progress: Tells = Tells.ITS_OWN
    keeps_scratch: bool = False
    is_helper: bool = False
    span: tuple[float, float] = (0.0, 1.0)


class JobKind:
    """One kind of job; its subclass has an ``open`` with the arguments that such a job needs.

    Attributes:
        name: as on the wire and in the database.
        unit: what a job's progress counts.
        shards: the kinds of its shards, in the order of its stages; helpers last.
        makes: the kind of what it brings forth.
        table: of what it brings forth, where that has a row of its own under the id of the job's output.
        has_children: whether it consists of other jobs instead of shards.
        decisive: settings without which two such jobs go other ways, so that one says nothing of the other's time.
    """

    name: Name
    unit: str
    shards: tuple[ShardKind[Any], ...] = ()
    table: ClassVar[type[Made]]
    has_children = False
    decisive: tuple[str, ...] = ()

    @property
    def makes(self) -> str:
        """The kind of the references in a job's ``outputs``."""
        return self.name

    def end(self, session: Session, job: JobRow, state: Unmade, message: str) -> None:
        """Mark what the job should have brought forth failed or cancelled, unless it is ready.

        Args:
            session: the transaction that ends the job.
            job: locked.
            state: what it is from now on.
            message: why it failed, for people.
        """
        end_pending(session, self.table, output_of(job), state)

    def reopen(self, session: Session, job: JobRow) -> None:
        """Mark what a failed job should have brought forth pending again."""
        required(session, self.table, output_of(job)).state = "pending"

    def subject(self, job: Job) -> str | None:
        """What the job is about, where that is not the scene that it was made from."""
        return None

    def path(self, output_id: str) -> str:
        """Where the API serves what such a job has made, below ``/v1``."""
        return f"{self.makes}s/{output_id}"

    def open_next(self, session: Session, parent: JobRow, ended: JobRow, children: Sequence[JobRow]) -> bool:
        """Open what follows the child of a parent that has just ended; False when all is done.

        Args:
            session: the transaction that ends the child.
            parent: the job that the child belongs to.
            ended: the child that has just succeeded.
            children: all of the parent's, in the order in which they were opened.
        """
        raise NotImplementedError

    def stage_opened(self, session: Session, parent: JobRow, child: JobRow) -> None:
        """A child has gone on to its next stage: open what need not wait for the child's end."""
        raise NotImplementedError

    def chain(self, parent: JobRow, children: Sequence[JobRow]) -> list[tuple[str, dict[str, Any]]]:
        """Kind and configuration of all jobs that a parent will have had, as far as can be told from those opened."""
        raise NotImplementedError

    def seconds(self, config: dict[str, Any]) -> float:
        """About how long such a job takes on the sample scene and two cores [s]; only the ratios count."""
        raise NotImplementedError

    def queued(
        self,
        session: Session,
        *,
        total: float,
        inputs: list[Reference],
        output_id: str | None,
        config: dict[str, Any],
        parent: JobRow | None = None,
    ) -> JobRow:
        """A new job of this kind without shards yet, and its first event.

        Args:
            session: the transaction that it belongs to.
            total: of its progress, in ``unit``.
            inputs: what it reads, with digests.
            output_id: of the pending row that it will fill; None when that is known later.
            config: its settings, as JSON.
            parent: the job that it is a child of.
        """
        outputs = [] if output_id is None else [Reference(kind=self.makes, id=output_id)]
        job = JobRow(
            id=new_id("job"),
            kind=self.name,
            state="queued",
            parent_id=None if parent is None else parent.id,
            progress=Progress(total=total, unit=self.unit).model_dump(),
            created_at=utc_now(),
            inputs=[reference.model_dump(mode="json") for reference in inputs],
            outputs=[reference.model_dump(mode="json") for reference in outputs],
            config=config,
        )
        job.stage = 0
        session.add(job)
        session.flush()
        append_event(session, job.id, "state", {"state": "queued"})
        if parent is not None:
            data = {"message": f"{self.name} queued", "child": job.id, "kind": self.name}
            append_event(session, parent.id, "log", data)
        return job

    def begin(self, session: Session, job: JobRow, row: Any, payload: dict[str, Any]) -> JobRow:
        """Add the pending row that the job will fill, and put its first stage up.

        Args:
            session: the transaction that it belongs to.
            job: from ``queued``.
            row: a new row of what the job makes; its origin is filled in here. None where it is stored already.
            payload: of the first shard.
        """
        if row is not None:
            row.state, row.created_at, row.job_id = "pending", utc_now(), job.id
            row.lineage = pending_lineage(job)
            session.add(row)
        put_up(session, job, Stage(self.shards[0].name, payload))
        return job

    def fulfil(self, job: JobRow, output_id: str, digest: str | None) -> None:
        """The job's output is there: its reference gets its digest."""
        job.outputs = [Reference(kind=self.makes, id=output_id, digest=digest).model_dump(mode="json")]


def output_of(job: JobRow) -> str:
    """The id of what the job makes."""
    return str(job.outputs[0]["id"])


def share_of(job: JobRow) -> float:
    """How much of a stored job is done, 0 to 1."""
    return 1.0 if job.state == "succeeded" else Progress.model_validate(job.progress).share


def pending_lineage(job: JobRow) -> dict[str, Any]:
    """The lineage of what a job will bring forth, before it has."""
    inputs = [Reference.model_validate(item) for item in job.inputs]
    return Lineage(inputs=inputs, job_id=job.id).model_dump(mode="json")
