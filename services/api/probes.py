"""Questions that may hang, asked so that nobody who wants the answer hangs with them: of health and of metrics.

A probe is asked in a thread of its own, one at a time: whoever asks while it is under way waits for that answer, and
no longer than its time since it began. So a part that hangs holds one thread, however many orchestrators ask, and
takes none of those that answer requests.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

import structlog

from physworld_storage.errors import StorageError

Answer = TypeVar("Answer")
READY_S = 1.5

log = structlog.get_logger("physworld.api")


class Probe(Generic[Answer]):
    """One question, asked by one thread at a time."""

    def __init__(self, name: str, ask: Callable[[], Answer]) -> None:
        self.name = name
        self._ask = ask
        self._lock = threading.Lock()
        self._under_way: Future[Answer] | None = None
        self._began = 0.0

    async def answer(self, seconds: float) -> Answer:
        """The answer. Raises TimeoutError ``seconds`` after the question was put, or what the question raises."""
        with self._lock:
            if self._under_way is None or self._under_way.done():
                self._under_way, self._began = Future(), time.monotonic()
                threading.Thread(
                    target=self._put, args=(self._under_way,), name=f"probe-{self.name}", daemon=True
                ).start()
            under_way, left_s = self._under_way, self._began + seconds - time.monotonic()
        asked = asyncio.wrap_future(under_way)
        done, _ = await asyncio.wait({asked}, timeout=max(0.0, left_s))
        if not done:
            raise TimeoutError(f"{self.name} has not answered within {seconds:g} s")
        return asked.result()

    async def state(self, seconds: float) -> str:
        """``ok``, or what anybody may know of the fault; the driver's words go to the log."""
        try:
            await self.answer(seconds)
        except TimeoutError:
            return f"timed out after {seconds:g} s"
        except StorageError as error:
            log.warning("not_ready", part=self.name, error=str(error))
            return error.told
        return "ok"

    def _put(self, answer: Future[Answer]) -> None:
        try:
            answer.set_result(self._ask())
        except Exception as error:  # noqa: BLE001 - raised again where the answer is awaited
            answer.set_exception(error)
