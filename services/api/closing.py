"""Knowing that the server is about to stop, so that answers that wait can be given now.

A server stops accepting at SIGTERM and then waits for the answers under way; a long poll or an event stream
would keep it waiting. Servers install their signal handlers before the application starts, so the
application puts its own in front and takes it away again. Outside the main thread (tests) nothing is told.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from types import FrameType

from fastapi import FastAPI


class Closing:
    """Whether the server was told to stop."""

    def __init__(self) -> None:
        self._told = False

    def __bool__(self) -> bool:
        return self._told

    @asynccontextmanager
    async def lifespan(self, app: FastAPI) -> AsyncIterator[None]:
        """Listen for the stop while the application runs."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        servers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

        def tell(number: int, frame: FrameType | None) -> None:
            self._told = True
            handler = servers[signal.Signals(number)]
            if callable(handler):
                handler(number, frame)
            elif handler == signal.SIG_DFL:
                signal.signal(number, signal.SIG_DFL)
                signal.raise_signal(number)

        for number in servers:
            signal.signal(number, tell)
        try:
            yield
        finally:
            for number, handler in servers.items():
                signal.signal(number, handler)
