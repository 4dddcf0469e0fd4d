"""Connections that do not get on: the server's patience with headers and bodies that never come to an end.

uvicorn closes a connection that is idle between two requests, but waits for ever for the rest of a request line, of
headers or of a body: some hundred half-sent requests keep their sockets for as long as their sender likes. Here headers
must be complete ``HEADERS_S`` after the connection was made or the last answer was given and their first byte came; a
body must bring ``BODY_BYTES`` every ``BODY_S``, unless it is the application that does not take more; and of the
connections whose headers are not complete the oldest is closed beyond ``MOST_WAITING``.

A WebSocket whose application has ended is cut off ``LINGER_S`` later, even if its client reads no more and so never
takes the close frame: uvicorn would keep it, with all that is written and not sent, for as long as the client likes.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from contextlib import suppress
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import InvalidState

HEADERS_S = 10.0
BODY_S, BODY_BYTES = 20.0, 4096
MOST_WAITING = 256
LINGER_S, LAST_S = 10.0, 0.5
TIMED_OUT = b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"

_waiting: OrderedDict[Connection, None] = OrderedDict()
"""Connections of this process whose headers are not complete, oldest first."""


class Connection(H11Protocol):
    """uvicorn's protocol on h11, watched while a request arrives; for ``uvicorn.Config(http=...)``."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._watched: type[Any] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._received = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for headers."""
        super().connection_made(transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        """Take data in, and see what is waited for now; nothing where it opened a WebSocket."""
        self._received += len(data)
        super().data_received(data)
        if self.transport.get_protocol() is self:
            self._watch()
        else:
            self._rest()

    def connection_lost(self, exc: Exception | None) -> None:
        """Nothing is waited for any more."""
        self._rest()
        super().connection_lost(exc)

    def _watch(self) -> None:
        state = self.conn.their_state
        if state is self._watched:
            return
        self._rest()
        self._watched = state
        if state is h11.IDLE:
            _waiting[self] = None
            self._timer = self.loop.call_later(HEADERS_S, self._give_up)
            if len(_waiting) > MOST_WAITING:
                next(iter(_waiting))._give_up()
        elif state is h11.SEND_BODY:
            self._received = 0
            self._timer = self.loop.call_later(BODY_S, self._measure)

    def _rest(self) -> None:
        _waiting.pop(self, None)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _measure(self) -> None:
        """Whether the body gets on."""
        if self._received < BODY_BYTES and not self.flow.read_paused:
            self._give_up()
            return
        self._received = 0
        self._timer = self.loop.call_later(BODY_S, self._measure)

    def _give_up(self) -> None:
        self._rest()
        if not self.transport.is_closing():
            if self.cycle is None or not self.cycle.response_started or self.cycle.response_complete:
                self.transport.write(TIMED_OUT)
            self.transport.close()


class Session(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket, which lets go of clients that read no more; for ``uvicorn.Config(ws=...)``."""

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        """The application has ended: its connection has ``LINGER_S`` left to take what was written."""
        super().on_task_complete(task)
        self.loop.call_later(LINGER_S, self.transport.abort)

    def shutdown(self) -> None:
        """The server ends: ``LAST_S`` are left. uvicorn fails where a client had begun to close already."""
        with suppress(InvalidState):
            super().shutdown()
        self.transport.close()
        self.loop.call_later(LAST_S, self.transport.abort)
