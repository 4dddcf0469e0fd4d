"""What lasts longer than its request ends with the credential that opened it, within seconds.

One query every ``CHECK_S`` asks for all credentials that have something open in this process; none while nothing is
open. A stream of events hears of the end as it hears of a client that leaves, so none has to know of keys. A file that
is being sent is finished: half of one would be no use to anybody.
While the database is away nothing ends: nobody can have revoked anything either.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import structlog
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from physworld_storage.access import credentials
from physworld_storage.database import Database
from physworld_storage.errors import StorageError

CHECK_S = 2.0

log = structlog.get_logger("physworld.api")


class Endings:
    """The credentials that have something open in this process."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._open: dict[str, list[asyncio.Event]] = {}
        self._checking: asyncio.Task[None] | None = None

    @asynccontextmanager
    async def of(self, credential: str) -> AsyncIterator[asyncio.Event]:
        """An event that is set once the credential is over, for as long as the block lasts."""
        ended = asyncio.Event()
        self._open.setdefault(credential, []).append(ended)
        if self._checking is None or self._checking.done():
            self._checking = asyncio.create_task(self._check())
        try:
            yield ended
        finally:
            waiting = self._open[credential]
            waiting.remove(ended)
            if not waiting:
                del self._open[credential]

    async def _check(self) -> None:
        while self._open:
            await asyncio.sleep(CHECK_S)
            asked = set(self._open)
            try:
                good = await run_in_threadpool(self._active, asked)
            except StorageError as error:
                log.warning("credentials_not_checked", error=str(error))
                continue
            for credential in asked - good:
                for ended in self._open.get(credential, []):
                    ended.set()

    def _active(self, asked: set[str]) -> set[str]:
        with self._database.reading() as session:
            return credentials.active(session, asked)


class EndWithCredential:
    """ASGI middleware: tells a stream of events that its credential is over, as if its client had left.

    The credential is in the request's state once somebody has checked it. A stream that was cut off this way is ended
    properly, so that the client connects again, and learns why it may not.
    """

    def __init__(self, app: ASGIApp, endings: Endings) -> None:
        self.app = app
        self.endings = endings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on; costs nothing unless the response listens for its client's leaving."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        body_read = events = under_way = False

        async def receive_or_end() -> Message:
            nonlocal body_read
            credential = scope.get("state", {}).get("credential")
            if not body_read or credential is None:
                message = await receive()
                body_read = not message.get("more_body", False)
                return message
            async with self.endings.of(credential) as ended:
                listening = asyncio.ensure_future(receive())
                ending = asyncio.ensure_future(ended.wait())
                try:
                    await asyncio.wait({listening, ending}, return_when=asyncio.FIRST_COMPLETED)
                    if ending.done() and events:
                        return {"type": "http.disconnect"}
                    return await listening
                finally:
                    ending.cancel()
                    listening.cancel()

        async def send_and_note(message: Message) -> None:
            nonlocal events, under_way
            if message["type"] == "http.response.start":
                events = Headers(scope=message).get("Content-Type", "").startswith("text/event-stream")
            under_way = message["type"] == "http.response.start" or bool(message.get("more_body", False))
            await send(message)

        await self.app(scope, receive_or_end, send_and_note)
        if events and under_way:
            await send({"type": "http.response.body", "body": b"", "more_body": False})
