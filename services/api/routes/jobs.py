"""Jobs: list, look at, wait for, follow and cancel."""

from __future__ import annotations

import time
from typing import Annotated

import anyio
from fastapi import APIRouter, Header, Query, Response
from sse_starlette import EventSourceResponse
from starlette.concurrency import run_in_threadpool

from schemas.base import Page
from schemas.job import TERMINAL_STATES, Job, JobKind, JobState
from services.api.dependencies import ClosingDep, DatabaseDep, ObjectId, PageDep
from services.api.errors import documented
from services.api.idempotency import IdempotencyDep, accepted, job_links
from services.api.sse import event_response, pending_events
from storage import jobs
from storage.database import Database

router = APIRouter(prefix="/jobs", tags=["jobs"])

MAX_WAIT_S = 60
POLL_S = 0.2
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
    closing: ClosingDep,
    wait: Annotated[
        float, Query(ge=0, le=MAX_WAIT_S, description="seconds to wait for the job's end before answering")
    ] = 0,
) -> Job:
    """A job; with `wait` the answer comes when the job has ended, or after that many seconds."""
    until = time.monotonic() + wait
    while True:
        job = await run_in_threadpool(_read, database, job_id)
        left = until - time.monotonic()
        if job.state in TERMINAL_STATES or left <= 0 or closing:
            return job_links(job)
        await anyio.sleep(min(POLL_S, left))


@router.post(
    "/{job_id}/cancel",
    status_code=202,
    response_model=Job,
    responses=documented(401, 403, 404, 409, 422),
)
def cancel_job(job_id: ObjectId, idempotency: IdempotencyDep) -> Response:
    """Ask a job (and its children) to stop. A job that has ended stays as it is."""
    return idempotency.run(job_id, lambda session: accepted(jobs.cancel_job(session, job_id)))


@router.get(
    "/{job_id}/events",
    response_class=EventSourceResponse,
    responses={
        200: {
            "description": "Server-sent events; `id` is the event's seq, `data` an Event as JSON",
            "content": {"text/event-stream": {"schema": {"type": "string"}}},
        },
        204: {"description": "The job has ended and the client has seen every event"},
        **documented(401, 403, 404, 422),
    },
)
def follow_job(
    job_id: ObjectId,
    database: DatabaseDep,
    closing: ClosingDep,
    last_event_id: Annotated[int, Header(ge=0, le=MAX_SEQ, description="resume after this event")] = 0,
) -> Response:
    """Follow a job until it has ended."""
    batch, ended = pending_events(database, job_id, last_event_id)
    if ended and not batch:
        return Response(status_code=204)
    return event_response(database, job_id, batch, last_event_id, ended, closing)


def _read(database: Database, job_id: str) -> Job:
    with database.reading() as session:
        return jobs.get_job(session, job_id)
