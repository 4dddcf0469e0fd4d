"""The events of followed jobs, read from the database by one poller for everybody who follows.

A job that somebody follows has a channel: its newest events, each serialised once. One task of this process asks the
database for what is new of all followed jobs together, so fifty followers cost what one does. Who begins further back,
or reads too slowly for the channel, reads the past from the database in batches, a few readers at a time, and joins the
channel where it begins; no event is missed and none comes twice, since a job's ``seq`` only grows.

A follower that says where it left off (``Last-Event-ID``) gets everything since. One that begins from the start gets
every ``state`` and ``log`` event, and of the ``progress`` events, each of which makes those before it worthless, only
those among the newest ``RECENT`` events.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import anyio
import structlog
from sse_starlette import ServerSentEvent
from starlette.concurrency import run_in_threadpool

from physworld_schemas.job import TERMINAL_STATES, Event, Job
from physworld_services.api.closing import Closing
from physworld_services.api.errors import ApiProblem
from physworld_storage.database import Database
from physworld_storage.errors import StorageError
from physworld_storage.jobs import events, jobs

POLL_S = 0.25
AWAY_S = 2.0
"""Pause of the poller after a database that does not answer."""
CLOSING_S = 0.5
"""How often a follower looks whether the server stops."""
RECENT = 1000
BATCH = 500
READERS = 2
"""Batches of the past that are read at the same time."""
MOST_STREAMS, MOST_STREAMS_OF_A_KEY = 400, 100
RETRY_AFTER = {"Retry-After": "5"}

log = structlog.get_logger("physworld.feed")


@dataclass(frozen=True)
class Start:
    """Where a follower begins.

    Attributes:
        seq: the last event that it has.
        tip: the job's newest event.
        whole_after: progress events up to this one are left out.
        ended: the job has ended, so nothing follows the tip.
    """

    seq: int
    tip: int
    whole_after: int
    ended: bool


class Channel:
    """What is new of one job: ``recent`` holds every event after ``floor``, up to ``last``."""

    def __init__(self, tip: int) -> None:
        self.recent: deque[tuple[int, ServerSentEvent]] = deque()
        self.floor = self.last = tip
        self.ended = False
        self.followers = 0
        self.changed = asyncio.Event()

    def add(self, found: Sequence[Event], ended: bool) -> None:
        """Take in new events and wake whoever waits."""
        for event in found:
            if len(self.recent) == RECENT:
                self.floor = self.recent.popleft()[0]
            self.recent.append((event.seq, message_of(event)))
            self.last = event.seq
        self.ended = self.ended or ended
        if found or ended:
            self.changed.set()
            self.changed = asyncio.Event()


class Feed:
    """The channels of one process, and the task that fills them while there are any."""

    def __init__(self, database: Database, closing: Closing) -> None:
        self._database = database
        self._closing = closing
        self._channels: dict[str, Channel] = {}
        self._poller: asyncio.Task[None] | None = None
        self._readers = anyio.CapacityLimiter(READERS)
        self._streams: Counter[str] = Counter()

    async def start(self, job_id: str, seq: int | None) -> Start:
        """Where a follower begins that has seen the events up to ``seq``; None: it has seen nothing.

        Raises NotFound for an unknown job.
        """
        return await anyio.to_thread.run_sync(self._start, job_id, seq, limiter=self._readers)

    def admit(self, key_id: str) -> None:
        """Refuse one stream too many. Raises ApiProblem: 429 of this key, 503 of this process."""
        if self._streams[key_id] >= MOST_STREAMS_OF_A_KEY:
            told = f"the key {key_id} follows {self._streams[key_id]} streams, the most that one key may"
            raise ApiProblem(429, "too_many_streams", told, headers=RETRY_AFTER)
        if self._streams.total() >= MOST_STREAMS:
            told = f"{self._streams.total()} streams are followed here, the most that this process serves"
            raise ApiProblem(503, "too_many_streams", told, headers=RETRY_AFTER)

    async def follow(self, job_id: str, start: Start, key_id: str) -> AsyncIterator[ServerSentEvent]:
        """The job's events after ``start``, until it has ended or the server stops."""
        self._streams[key_id] += 1
        try:
            with self._joined(job_id, start.tip) as channel:
                seq = start.seq
                while not self._closing:
                    changed = channel.changed
                    if seq < channel.floor:
                        past = await anyio.to_thread.run_sync(
                            self._past, job_id, seq, start.whole_after, limiter=self._readers
                        )
                        for event in past:
                            yield message_of(event)
                        seq = past[-1].seq if past else channel.floor
                        continue
                    for number, message in list(channel.recent):
                        if number > seq:
                            seq = number
                            yield message
                    if (start.ended and seq >= start.tip) or (channel.ended and seq >= channel.last):
                        return
                    with anyio.move_on_after(CLOSING_S):
                        await changed.wait()
        finally:
            self._streams[key_id] -= 1
            self._streams += Counter()  # keys without a stream are forgotten

    async def wait(self, job_id: str, tip: int, seconds: float) -> None:
        """Return when a job whose newest event is ``tip`` has ended, after ``seconds``, or when the server stops."""
        with self._joined(job_id, tip) as channel, anyio.move_on_after(seconds):
            while not (channel.ended or self._closing):
                changed = channel.changed
                with anyio.move_on_after(CLOSING_S):
                    await changed.wait()

    @contextmanager
    def _joined(self, job_id: str, tip: int) -> Iterator[Channel]:
        channel = self._channels.setdefault(job_id, Channel(tip))
        channel.followers += 1
        if self._poller is None:
            self._poller = asyncio.create_task(self._poll())
        try:
            yield channel
        finally:
            channel.followers -= 1
            if not channel.followers:
                del self._channels[job_id]

    async def _poll(self) -> None:
        try:
            while self._channels:
                pause = POLL_S
                try:
                    after = {job_id: channel.last for job_id, channel in self._channels.items()}
                    found, ended = await run_in_threadpool(self._new, after)
                    for job_id in after:
                        if job_id in self._channels:
                            self._channels[job_id].add(found.get(job_id, []), job_id in ended)
                except StorageError as error:
                    log.warning("events_not_read", error=str(error))
                    pause = AWAY_S
                await asyncio.sleep(pause)
        finally:
            self._poller = None

    def _new(self, after: dict[str, int]) -> tuple[dict[str, list[Event]], set[str]]:
        """Events of jobs after these places, and the jobs that have ended and of which that is all."""
        with self._database.reading() as session:
            states = jobs.states_of(session, list(after))  # before the events: an end comes with its event
            found, more = events.newer(session, after, RECENT)
        return found, {job_id for job_id, state in states.items() if state in TERMINAL_STATES} - more

    def _start(self, job_id: str, seq: int | None) -> Start:
        with self._database.reading() as session:
            job: Job = jobs.get_job(session, job_id)
            tip = events.newest(session, job_id)
            whole_after = 0 if seq is not None else events.newest(session, job_id, RECENT)
        return Start(seq or 0, tip, whole_after, job.state in TERMINAL_STATES)

    def _past(self, job_id: str, seq: int, whole_after: int) -> list[Event]:
        with self._database.reading() as session:
            return events.events_after(session, job_id, seq, BATCH, whole_after=whole_after)


def message_of(event: Event) -> ServerSentEvent:
    """The event as it is sent; ``seq`` is its id."""
    return ServerSentEvent(id=str(event.seq), event=event.type, data=event.model_dump_json())
