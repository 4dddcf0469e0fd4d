"""Live sessions over WebSocket: control velocities in, frames of points out at the model's clock or faster.

``/live?model=NAME&version=N&ticket=…&frames=2&part=points``: first a JSON text ``{"type": "ready", …}``, then binary
frames (``session``), ``frames`` of them a tick, interpolated; ``part=vertices`` for the graph's vertices. The client
sends binary control messages, and as JSON text ``{"type": "reset"}`` and ``{"type": "factors", "factors": {NAME: x}}``,
properties of the body relative to the model's, beside which ``"strengths": {NAME: x}`` may stand, strengths of effects
in their units. Velocities last ``HOLD_S``: a client that falls silent stops its grips. ``{"type": "open", "grips":
[1]}`` opens these grips and closes the others, where the version has a model for those that hold then.

With ``{"type": "twin", "on": true}`` the calibrated twin is run beside the model, on the same grips
(``physworld_services.inference.companion``): its frames bear the flag 2; texts of the type ``twin`` say how it does.

The model is stepped in a thread, never on the event loop. A slow reader gets fewer frames, the newest each time:
nothing queues up here, only in the connection's buffers. A session ends after ``IDLE_S`` without a message (4408), at
a message that cannot be read (1007), when the client does not take a frame within ``SEND_S`` (4409); a process holds
``MOST_SESSIONS`` of them (1013). One that is refused (1008) says why by a problem's code: ``unauthenticated``,
``not_found``, ``conflict``, ``model_unreadable``.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import structlog
from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from physworld.arrays import Array
from physworld.worldmodel.errors import VersionUnreadable
from physworld.worldmodel.published import PublishedModel
from physworld_schemas.live import close_reason
from physworld_schemas.model import ModelVersion
from physworld_services.inference.companion import Companion, TwinStopped
from physworld_services.inference.models import Models
from physworld_services.inference.session import Control, ControlRefused, LiveSession, checked_strength
from physworld_storage.access import tickets
from physworld_storage.database import Database
from physworld_storage.errors import StorageError

MOST_SESSIONS, MOST_TWINS, THREADS = 4, 2, 2
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
        device: of Warp, for twins.
    """

    def __init__(
        self,
        database: Database,
        models: Models,
        *,
        idle_s: float = IDLE_S,
        most: int = MOST_SESSIONS,
        device: str = "cpu",
    ) -> None:
        self._database, self._models = database, models
        self._idle_s, self._most, self._open = idle_s, most, 0
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="live")
        self._device, self._twins = device, asyncio.Semaphore(MOST_TWINS)

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
            found, published = await run_in_threadpool(self._models.get, model, version)
            vertices = query.get("part") == "vertices"
            session = await run_in_threadpool(LiveSession, published, vertices=vertices)
            twin = _Beside(published, lambda: self._twin_of(found), self._device, self._twins)
            await _Connection(socket, session, twin, self._pool, frames, self._idle_s).run()
        except (StorageError, VersionUnreadable) as error:
            log.warning("live_session_refused", model=model, version=version, error=str(error))
            await socket.close(POLICY, close_reason(error.code, str(error)))
        except WebSocketDisconnect:
            pass
        finally:
            self._open -= 1

    def _twin_of(self, version: ModelVersion) -> bytes:
        """The twin's npz. Raises TwinStopped."""
        try:
            return self._models.twin(version)
        except StorageError as error:
            raise TwinStopped(f"the twin of the version cannot be read: {error}") from error

    def _key_of(self, ticket: str, subject: str) -> object | None:
        with self._database.session() as session:
            return tickets.redeem(session, ticket, subject)


@dataclass(frozen=True)
class _Beside:
    """What a twin beside a session is made of: its npz as ``read`` gives it, and a place among the process's twins."""

    model: PublishedModel
    read: Callable[[], bytes]
    device: str
    places: asyncio.Semaphore


class _Connection:
    """A session with its connection: one task reads, one steps, one sends the newest frames; one steps the twin."""

    def __init__(
        self,
        socket: WebSocket,
        session: LiveSession,
        beside: _Beside,
        pool: ThreadPoolExecutor,
        frames: int,
        idle_s: float,
    ) -> None:
        self._socket, self._session, self._beside, self._pool = socket, session, beside, pool
        self._frames, self._idle_s = frames, idle_s
        self._control: Control | None = None
        self._heard_at = self._steered_at = asyncio.get_running_loop().time()
        self._reset = False
        self._newest: bytes | None = None
        self._newest_of_twin: bytes | None = None
        self._texts: list[str] = []
        self._fresh = asyncio.Event()
        self._factors: dict[str, Any] = {}
        self._strengths: dict[str, Any] = {}
        self._twin: Companion | None = None
        self._twin_task: asyncio.Task[None] | None = None
        self._only_of_twin: dict[str, dict[str, Any]] = {}

    async def run(self) -> None:
        """Until the client leaves, falls silent, sends nonsense or stops reading."""
        await self._socket.send_text(json.dumps({"type": "ready", **self._session.describe()}))
        tasks = [asyncio.create_task(work) for work in (self._read(), self._step(), self._send())]
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._let_twin_go()
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
        kind = message.get("type")
        if kind == "reset":
            self._reset = True
        elif kind == "factors":
            self._session.set_factors(dict(message["factors"]))
            if "strengths" in message:
                await self._set_strengths(dict(message["strengths"]))
            self._factors = dict(message["factors"])
            if self._twin is not None:
                self._twin.change(self._factors, self._strengths)
        elif kind == "open":
            self._session.open_grips(list(message["grips"]))
            if message["grips"] and self._twin_task is not None:
                await self._let_twin_go()
                self._say({"state": "refused", "reason": "a twin that is run live cannot let go"})
        elif kind == "twin":
            await self._let_twin_go()
            if message["on"] is True:
                self._twin_task = asyncio.create_task(self._run_twin())

    async def _set_strengths(self, strengths: dict[str, Any]) -> None:
        """Give the model those that it was trained over; the twin takes them all."""
        own = self._session.strengths
        known = {name: told for name, told in self._only_of_twin.items() if name not in own}
        for name, told in known.items():
            if name in strengths:
                checked_strength(name, strengths[name], told["low"], told["high"])
        of_model = {name: value for name, value in strengths.items() if name not in known}
        work = self._session.set_strengths  # the weights are prepared anew
        await asyncio.get_running_loop().run_in_executor(self._pool, work, of_model)
        self._strengths = strengths

    async def _run_twin(self) -> None:
        """The twin beside the model, until it is sent away."""
        beside = self._beside
        if beside.places.locked():
            reason = f"the {MOST_TWINS} twins of the process are all taken"
            self._say({"state": "refused", "reason": reason})
            return
        async with beside.places:
            twin = Companion(
                beside.read, beside.device, beside.model, self._say, self._show_twin, self._restart
            )
            if self._factors or self._strengths:
                twin.change(self._factors, self._strengths)
            self._twin = twin
            await twin.run()
        self._twin = None

    async def _let_twin_go(self) -> None:
        task, self._twin, self._twin_task = self._twin_task, None, None
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    def _lead_twin(self) -> None:
        """Tell the twin where the session is: at its start where the prediction was set back."""
        if self._twin is not None and self._session.tick_number == 0:
            self._twin.reset()
        elif self._twin is not None:
            self._twin.follow(self._session.tick_number, self._session.controllers)

    def _say(self, told: dict[str, Any]) -> None:
        self._only_of_twin |= {one["name"]: one for one in told.get("strengths", ())}
        self._texts.append(json.dumps({"type": "twin", **told}))
        self._fresh.set()

    def _show_twin(self, tick: int, vertices: Array, controllers: Array) -> None:
        self._newest_of_twin = self._session.twin_frame(tick, vertices, controllers)
        self._fresh.set()

    def _restart(self) -> None:
        self._reset = True

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
                if self._twin is not None:
                    self._twin.reset()
            await loop.run_in_executor(self._pool, self._session.tick, velocity)
            self._lead_twin()
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
            texts, self._texts = self._texts, []
            frames = [frame for frame in (self._newest, self._newest_of_twin) if frame is not None]
            self._newest = self._newest_of_twin = None
            try:
                async with asyncio.timeout(SEND_S):  # wait_for may swallow the cancellation (cpython 86296)
                    for text in texts:
                        await self._socket.send_text(text)
                    for frame in frames:
                        await self._socket.send_bytes(frame)
                        self._session.sent(frame)
            except TimeoutError:
                return TOO_SLOW, f"a frame was not taken within {SEND_S:g} s"
            except (WebSocketDisconnect, RuntimeError):
                return 0, ""
