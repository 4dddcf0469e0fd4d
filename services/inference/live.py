"""Live sessions over WebSocket: control velocities in, frames of points out at the model's clock or faster.

``/live?model=NAME&version=N&ticket=…&frames=2&part=points``: first a JSON text ``{"type": "ready", …}``, then binary
frames (``session``), ``frames`` of them a tick, interpolated; ``part=vertices`` for the graph's vertices. The client
sends binary control messages, and as JSON text ``{"type": "reset"}`` and ``{"type": "factors", "factors": {NAME: x}}``,
properties of the body relative to the model's, beside which ``"strengths": {NAME: x}`` may stand, strengths of effects
in their units. Velocities last ``HOLD_S``: a client that falls silent stops its grips.

The model is stepped in a thread, never on the event loop. A slow reader gets fewer frames, the newest each time:
nothing queues up here, only in the connection's buffers. A session ends after ``IDLE_S`` without a message (4408), at
a message that cannot be read (1007), when the client does not take a frame within ``SEND_S`` (4409); a process holds
``MOST_SESSIONS`` of them (1013). One that is refused (1008) says why by a problem's code: ``unauthenticated``,
``not_found``, ``conflict``, ``model_unreadable``.
"""

from __future__ import annotations

import asyncio
import json
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import numpy as np
import structlog
from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from physworld.worldmodel.errors import VersionUnreadable
from physworld_schemas.live import close_reason
from physworld_services.inference.models import Models
from physworld_services.inference.session import Control, ControlRefused, LiveSession
from physworld_storage.access import tickets
from physworld_storage.database import Database
from physworld_storage.errors import StorageError

MOST_SESSIONS, THREADS = 4, 2
IDLE_S, SEND_S, CLOSE_S, HOLD_S = 120.0, 10.0, 1.0, 0.3
MOST_FRAMES = 4
UNREADABLE, TRY_LATER, POLICY, IDLE, TOO_SLOW = 1007, 1013, 1008, 4408, 4409

log = structlog.get_logger("physworld.live")


class LiveSessions:
    """The sessions of one process.

    Args:
        database: redeems tickets.
        models: versions that are loaded.
        idle_s: after which a session that nobody steers ends [s].
        most: sessions at a time.
    """

    def __init__(
        self, database: Database, models: Models, *, idle_s: float = IDLE_S, most: int = MOST_SESSIONS
    ) -> None:
        self._database, self._models = database, models
        self._idle_s, self._most, self._open = idle_s, most, 0
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="live")

    async def serve(self, socket: WebSocket) -> None:
        """Serve one connection until it ends."""
        query = socket.query_params
        model, version, ticket = (query.get(name, "") for name in ("model", "version", "ticket"))
        frames = min(max(int(query["frames"]), 1), MOST_FRAMES) if query.get("frames", "").isdecimal() else 1
        await socket.accept()
        if await run_in_threadpool(self._key_of, ticket, f"live:{model}:{version}") is None:
            why = close_reason("unauthenticated", "the ticket is unknown, over or for something else")
            await socket.close(POLICY, why)
            return
        if self._open >= self._most:
            await socket.close(TRY_LATER, f"{self._open} sessions are open, the most of this process")
            return
        self._open += 1
        try:
            _, published = await run_in_threadpool(self._models.get, model, version)
            vertices = query.get("part") == "vertices"
            session = await run_in_threadpool(LiveSession, published, vertices=vertices)
            await _Connection(socket, session, self._pool, frames, self._idle_s).run()
        except (StorageError, VersionUnreadable) as error:
            log.warning("live_session_refused", model=model, version=version, error=str(error))
            await socket.close(POLICY, close_reason(error.code, str(error)))
        except WebSocketDisconnect:
            pass
        finally:
            self._open -= 1

    def _key_of(self, ticket: str, subject: str) -> object | None:
        with self._database.session() as session:
            return tickets.redeem(session, ticket, subject)


class _Connection:
    """A session with its connection: one task reads, one steps, one sends the newest frame."""

    def __init__(
        self, socket: WebSocket, session: LiveSession, pool: ThreadPoolExecutor, frames: int, idle_s: float
    ) -> None:
        self._socket, self._session, self._pool = socket, session, pool
        self._frames, self._idle_s = frames, idle_s
        self._control: Control | None = None
        self._heard_at = self._steered_at = asyncio.get_running_loop().time()
        self._reset = False
        self._newest: bytes | None = None
        self._fresh = asyncio.Event()

    async def run(self) -> None:
        """Until the client leaves, falls silent, sends nonsense or stops reading."""
        await self._socket.send_text(json.dumps({"type": "ready", **self._session.describe()}))
        tasks = [asyncio.create_task(work) for work in (self._read(), self._step(), self._send())]
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        code, reason = next(iter(done)).result()
        if code and self._socket.application_state is WebSocketState.CONNECTED:
            with suppress(
                RuntimeError, TimeoutError
            ):  # the client may have gone meanwhile, or never read again
                async with asyncio.timeout(CLOSE_S):
                    await self._socket.close(code, reason)

    async def _read(self) -> tuple[int, str]:
        clock = asyncio.get_running_loop().time
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return 0, ""
            self._heard_at = clock()
            try:
                if message.get("bytes") is not None:
                    self._control, self._steered_at = self._session.read(message["bytes"]), clock()
                else:
                    await self._told(json.loads(message["text"]))
            except (
                ControlRefused,
                ValueError,
                LookupError,
                TypeError,
                AttributeError,
                RecursionError,
            ) as error:
                return UNREADABLE, str(error)[:120]

    async def _told(self, message: dict[str, Any]) -> None:
        if message.get("type") == "reset":
            self._reset = True
        elif message.get("type") == "factors":
            self._session.set_factors(dict(message["factors"]))
            if "strengths" in message:  # the weights are prepared anew
                set_strengths, strengths = self._session.set_strengths, dict(message["strengths"])
                await asyncio.get_running_loop().run_in_executor(self._pool, set_strengths, strengths)

    async def _step(self) -> tuple[int, str]:
        loop = asyncio.get_running_loop()
        still = np.zeros((len(self._session.describe()["controllers"]), 3))
        due = loop.time()
        while True:
            if loop.time() - self._heard_at > self._idle_s:
                return IDLE, f"no message for {self._idle_s:g} s"
            control = self._control
            moving = control is not None and loop.time() - self._steered_at < HOLD_S
            velocity = control.velocity if control is not None and moving else still
            if self._reset:
                self._reset = False
                self._session.reset()
            await loop.run_in_executor(self._pool, self._session.tick, velocity)
            for part in range(1, self._frames + 1):
                self._newest = self._session.frame(part / self._frames, control.number if control else 0)
                self._fresh.set()
                due += self._session.dt_s / self._frames
                await asyncio.sleep(max(0.0, due - loop.time()))
            if loop.time() - due > 0.5:  # too slow for real time: go on from now
                due = loop.time()

    async def _send(self) -> tuple[int, str]:
        while True:
            await self._fresh.wait()
            self._fresh.clear()
            frame, self._newest = self._newest, None
            if frame is None:
                continue
            try:
                async with asyncio.timeout(SEND_S):  # wait_for may swallow the cancellation (cpython 86296)
                    await self._socket.send_bytes(frame)
                self._session.sent(frame)
            except TimeoutError:
                return TOO_SLOW, f"a frame was not taken within {SEND_S:g} s"
            except (WebSocketDisconnect, RuntimeError):
                return 0, ""
