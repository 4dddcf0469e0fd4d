"""The event stream of a job (server-sent events), read from the database by polling.

Each event carries its ``seq`` as the SSE id; a client that reconnects with ``Last-Event-ID`` misses nothing
and sees nothing twice. The stream ends after the event that ends the job, or when the server stops (the
client connects again). A comment every 15 s keeps proxies from closing the connection.
"""

from __future__ import annotations

from collections.abc import AsyncIterator

import anyio
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.concurrency import run_in_threadpool

from schemas.job import TERMINAL_STATES, Event
from services.api.closing import Closing
from storage import events, jobs
from storage.database import Database

HEARTBEAT_S = 15
POLL_S = 0.25
CLOSING_S = 2.0  # for the streams to end by themselves when the server stops
BATCH = 500


def pending_events(database: Database, job_id: str, seq: int) -> tuple[list[Event], bool]:
    """Events after ``seq``, at most a batch, and whether the job has ended and none will follow them.

    Raises NotFound for an unknown job.
    """
    with database.reading() as session:
        job = jobs.get_job(session, job_id)
        batch = events.events_after(session, job_id, seq, BATCH)
    return batch, job.state in TERMINAL_STATES and len(batch) < BATCH


def event_response(
    database: Database, job_id: str, batch: list[Event], seq: int, ended: bool, closing: Closing
) -> EventSourceResponse:
    """The stream that begins with ``batch``, the events after ``seq`` that the caller has read already."""
    return EventSourceResponse(
        _stream(database, job_id, batch, seq, ended, closing),
        ping=HEARTBEAT_S,
        ping_message_factory=lambda: ServerSentEvent(comment="heartbeat"),
        shutdown_event=anyio.Event(),
        shutdown_grace_period=CLOSING_S,
    )


async def _stream(
    database: Database, job_id: str, batch: list[Event], seq: int, ended: bool, closing: Closing
) -> AsyncIterator[ServerSentEvent]:
    while True:
        for event in batch:
            seq = event.seq
            yield ServerSentEvent(id=str(event.seq), event=event.type, data=event.model_dump_json())
        if ended or closing:
            return
        if len(batch) < BATCH:
            await anyio.sleep(POLL_S)
        batch, ended = await run_in_threadpool(pending_events, database, job_id, seq)
