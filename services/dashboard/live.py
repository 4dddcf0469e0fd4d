"""Live parts of a page: a fragment is rendered again while it changes, and sent as a server-sent event.

The database is asked, not a broker: a page stays right whichever process did the work, and a stream that
was cut begins again with the whole fragment. Relative times count on in the browser and are no change.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import AsyncIterator, Callable

import structlog
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.concurrency import run_in_threadpool

from physworld_storage.errors import StorageError

POLL_SECONDS = 0.5
LIFETIME_SECONDS = 300.0  # then the browser connects again, and its session is checked again
FINISHED = "finished"  # name of the last event of a stream whose object will not change any more

_COUNTING = re.compile(r"(data-(?:ago|since)>)[^<]*")

Render = Callable[[], tuple[str, bool]]

log = structlog.get_logger("physworld.dashboard")


async def stream(render: Render) -> EventSourceResponse:
    """Stream ``render() -> (html, finished)``: an event for each change, the last one when finished.

    What the first rendering raises (no such object) is raised here, before anything is sent.
    """
    first = await run_in_threadpool(render)
    return EventSourceResponse(_changes(render, first), ping=15, headers={"Cache-Control": "no-store"})


async def _changes(render: Render, first: tuple[str, bool]) -> AsyncIterator[ServerSentEvent]:
    until = time.monotonic() + LIFETIME_SECONDS
    sent = ""
    html, finished = first
    while time.monotonic() < until:
        fixed = _COUNTING.sub(r"\1", html)
        if fixed != sent:
            sent = fixed
            yield ServerSentEvent(data=html)
        if finished:
            yield ServerSentEvent(data="", event=FINISHED)
            return
        await asyncio.sleep(POLL_SECONDS)
        try:
            html, finished = await run_in_threadpool(render)
        except StorageError as error:
            log.warning("live_stream_ended", error=str(error))
            return  # the browser connects again
