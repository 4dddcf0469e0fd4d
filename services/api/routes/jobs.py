"""Jobs: list, look at, wait for, follow, cancel and retry."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Header, Query, Response
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from physworld_schemas.base import Page
from physworld_schemas.job import TERMINAL_STATES, Job, JobKind, JobState
from physworld_services.api.dependencies import (
    ActorDep,
    DatabaseDep,
    FeedDep,
    ObjectId,
    PageDep,
    PrincipalDep,
)
from physworld_services.api.errors import documented
from physworld_services.api.idempotency import IdempotencyDep, accepted, job_links
from physworld_services.api.sse import STREAMED, event_response
from physworld_storage.access import audit
from physworld_storage.database import Database
from physworld_storage.idempotency import Answer
from physworld_storage.jobs import events, jobs

router = APIRouter(prefix="/jobs", tags=["jobs"])

MAX_WAIT_S = 60
MAX_SEQ = 2**63 - 1


@router.get("", responses=documented(401, 403, 422))
def list_jobs(
    database: DatabaseDep, page: PageDep, state: JobState | None = None, kind: JobKind | None = None
) -> Page[Job]:
    """Jobs, newest first."""
    with database.reading() as session:
        found = jobs.list_jobs(session, limit=page.limit, cursor=page.cursor, state=state, kind=kind)
    found.data = [job_links(job) for job in found.data]
    return found


@router.get("/{job_id}", responses=documented(401, 403, 404, 422))
async def get_job(
    job_id: ObjectId,
    database: DatabaseDep,
    feed: FeedDep,
    wait: Annotated[
        float, Query(ge=0, le=MAX_WAIT_S, description="seconds to wait for the job's end before answering")
    ] = 0,
) -> Job:
    """A job; with `wait` the answer comes when the job has ended, or after that many seconds."""
    job, tip = await run_in_threadpool(_read, database, job_id)
    if wait > 0 and job.state not in TERMINAL_STATES:
        await feed.wait(job_id, tip, wait)
        job, _ = await run_in_threadpool(_read, database, job_id)
    return job_links(job)


@router.post(
    "/{job_id}/cancel",
    status_code=202,
    response_model=Job,
    responses=documented(401, 403, 404, 409, 422),
)
def cancel_job(job_id: ObjectId, idempotency: IdempotencyDep, actor: ActorDep) -> Response:
    """Ask a job (and its children) to stop. A job that has ended stays as it is."""

    def work(session: Session) -> Answer:
        audit.record(session, actor, "job.cancelled", job_id)
        return accepted(jobs.cancel_job(session, job_id))

    return idempotency.run(job_id, work)


@router.post(
    "/{job_id}/retry",
    status_code=202,
    response_model=Job,
    responses=documented(401, 403, 404, 409, 422),
)
def retry_job(job_id: ObjectId, idempotency: IdempotencyDep, actor: ActorDep) -> Response:
    """Take a failed job (and its pipeline) up again: finished shards, journals and checkpoints are kept."""

    def work(session: Session) -> Answer:
        audit.record(session, actor, "job.retried", job_id)
        return accepted(jobs.retry_job(session, job_id))

    return idempotency.run(job_id, work)


@router.get(
    "/{job_id}/events",
    response_class=Response,
    responses={
        200: {
            "description": "Server-sent events; `id` is the event's seq, `data` an Event as JSON",
            "content": {"text/event-stream": {"itemSchema": STREAMED}},
        },
        204: {"description": "The job has ended and the client has seen every event"},
        **documented(401, 403, 404, 422, 429, 503),
    },
)
async def follow_job(
    job_id: ObjectId,
    feed: FeedDep,
    principal: PrincipalDep,
    last_event_id: Annotated[
        int | None, Header(ge=0, le=MAX_SEQ, description="resume after this event")
    ] = None,
) -> Response:
    """Follow a job until it has ended.

    With `Last-Event-ID` every event after that one is sent. Without it a long job's older progress events are left
    out; states and log entries never are.
    """
    feed.admit(principal.id)
    start = await feed.start(job_id, last_event_id)
    if start.ended and start.seq >= start.tip:
        return Response(status_code=204)
    return event_response(feed.follow(job_id, start, principal.id))


def _read(database: Database, job_id: str) -> tuple[Job, int]:
    """The job, and its newest event, which is read first: what ends the job after that is news."""
    with database.reading() as session:
        tip = events.newest(session, job_id)
        return jobs.get_job(session, job_id), tip
