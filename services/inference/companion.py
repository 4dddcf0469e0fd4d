"""The calibrated twin beside a live session: the engine on the same grips, in a process of its own.

Both begin at the session's start, and the twin takes every tick's grips in their order. Where the engine keeps up the
two are at the same tick; otherwise the twin goes its own pace, its real-time factor and how far it is behind are said,
and it catches up where nothing moves any more: a body at rest under grips that stay needs no computing. One that is
``MOST_BEHIND_S`` behind is stopped until the next reset.

It says what it is at as JSON texts, ``{"type": "twin", "state": …}``:

* ``starting``
* ``running``   ``real_time`` (simulated over computing time), ``behind_s``, ``strengths`` of its effects
* ``stopped``   ``reason``: it broke off or fell behind; a reset begins again
* ``refused``   ``reason``: it cannot be run live
"""

from __future__ import annotations

import asyncio
import json
import struct
import sys
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import structlog
from starlette.concurrency import run_in_threadpool

from physworld.arrays import Array
from physworld.worldmodel.published import PublishedModel
from physworld_scenes.limited import environment
from physworld_services.inference.twin_process import HEAD

MOST_BEHIND_S = 20.0
TELL_EVERY_S, CLOSE_S, BEGIN_S = 0.5, 2.0, 180.0
PACE_TICKS = 30
AT_REST = 2e-5
"""Of the body's size: a body whose vertices move less within a tick, under grips that stay, lies still."""
ROOT = Path(__file__).parents[2]

log = structlog.get_logger("physworld.live")


class TwinStopped(Exception):
    """The twin's process says why it cannot go on."""


class Companion:
    """A twin beside one session.

    Args:
        read: gives the twin's npz; may raise ``TwinStopped``.
        device: of Warp, on which it is run.
        model: the session's; the twin is shown at its vertices.
        say: takes a text for the client.
        show: takes a tick, vertices (n, 3) [m] and control points (K, 3) [m].
        restart: begins the session anew, so that both start together.
    """

    def __init__(
        self,
        read: Callable[[], bytes],
        device: str,
        model: PublishedModel,
        say: Callable[[dict[str, Any]], None],
        show: Callable[[int, Array, Array], None],
        restart: Callable[[], None],
    ) -> None:
        self._read, self._device, self._model, self._say = read, device, model, say
        self._show, self._restart = show, restart
        self._waiting: deque[tuple[int, Array]] = deque()
        self._asked: deque[tuple[bytes, bytes]] = deque()
        self._some = asyncio.Event()
        self._running = False
        self._size = float(np.ptp(model.spec.rest_vertices, axis=0).max())
        self.strengths: list[dict[str, Any]] = []

    def follow(self, tick: int, controllers: Array) -> None:
        """The session's ``tick`` is at these control points (K, 3) [m]."""
        if self._running:
            self._waiting.append((tick, controllers.copy()))
            self._some.set()

    def reset(self) -> None:
        """The session is back at its start."""
        self._waiting.clear()
        self._ask(b"R")

    def change(self, factors: Mapping[str, float], strengths: Mapping[str, float]) -> None:
        """Other properties, relative to the twin's own, and strengths of effects by name."""
        self._ask(b"F", json.dumps({"factors": dict(factors), "strengths": dict(strengths)}).encode())

    def _ask(self, kind: bytes, content: bytes = b"") -> None:
        self._asked.append((kind, content))
        self._some.set()

    async def run(self) -> None:
        """Until it is cancelled, or refused."""
        process = None
        try:
            self._say({"state": "starting"})
            content = await run_in_threadpool(self._read)
            process = await _started()
            async with asyncio.timeout(BEGIN_S):
                self.strengths = await self._begin(process, content)
            await self._go(process)
        except (TwinStopped, TimeoutError, asyncio.IncompleteReadError, OSError) as error:
            reason = str(error) if isinstance(error, TwinStopped) else "its process broke off"
            log.warning("twin_not_live", error=str(error))
            self._running = False
            self._say({"state": "refused", "reason": reason})
        finally:
            self._running = False
            if process is not None:
                await _ended(process)

    async def _begin(self, process: asyncio.subprocess.Process, content: bytes) -> list[dict[str, Any]]:
        model = self._model
        asked = {
            "dt_s": model.spec.dt_s,
            "index": model.spec.particle_index.tolist(),
            "start": model.start_controllers.tolist(),
            "start_s": model.start_time_s,
            "device": self._device,
        }
        await _send(process, b"B", json.dumps(asked).encode())
        await _send(process, b"N", content)
        strengths: list[dict[str, Any]] = json.loads(await _answer(process))["strengths"]
        return strengths

    async def _go(self, process: asyncio.subprocess.Process) -> None:
        """Tick after tick; one that breaks off waits for a reset."""
        clock = asyncio.get_running_loop().time
        paces: deque[float] = deque(maxlen=PACE_TICKS)
        dt_s, told_at, behind = self._model.spec.dt_s, -np.inf, 0
        before, places = None, self._model.start_controllers[-1]
        self._restart()
        self._running = True
        while True:
            if self._running and clock() - told_at > TELL_EVERY_S:
                told_at = clock()
                pace = dt_s / float(np.mean(paces)) if paces else None
                self._say(
                    {"state": "running", "real_time": pace, "behind_s": behind * dt_s}
                    | {"strengths": self.strengths}
                )
            if not self._some.is_set():
                await self._some.wait()
            self._some.clear()
            try:
                while self._asked:
                    kind, content = self._asked.popleft()
                    if kind == b"R":
                        before, places, self._running = None, self._model.start_controllers[-1], True
                    await _send(process, kind, content)
                if not self._waiting:
                    continue
                tick, now = self._waiting.popleft()
                await _send(process, b"C", np.ascontiguousarray(now, dtype="<f8").tobytes())
                answer = await _answer(process)
                paces.append(struct.unpack_from("<d", answer)[0])
                vertices = np.frombuffer(answer, "<f4", offset=8).reshape(-1, 3)
                resting = before is not None and np.abs(vertices - before).max() < AT_REST * self._size
                if resting and np.array_equal(now, places) and self._stays(now):
                    tick = self._waiting[-1][0] if self._waiting else tick
                    self._waiting.clear()
                before, places, behind = vertices, now, len(self._waiting)
                self._show(tick, vertices, now)
                if behind * dt_s > MOST_BEHIND_S:
                    raise TwinStopped(f"the engine fell {behind * dt_s:.0f} s behind the model")
            except TwinStopped as error:
                self._running = False
                self._waiting.clear()
                self._say({"state": "stopped", "reason": str(error)})
            if self._waiting or self._asked:
                self._some.set()

    def _stays(self, places: Array) -> bool:
        """Whether no control point moves in what is waiting."""
        return all(np.array_equal(there, places) for _, there in self._waiting)


async def _started() -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "physworld_services.inference.twin_process",
        cwd=ROOT,
        env=environment(),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )


async def _ended(process: asyncio.subprocess.Process) -> None:
    if process.returncode is None:
        process.kill()
    async with asyncio.timeout(CLOSE_S):
        await process.wait()


async def _send(process: asyncio.subprocess.Process, kind: bytes, content: bytes) -> None:
    assert process.stdin is not None
    process.stdin.write(HEAD.pack(kind, len(content)) + content)
    await process.stdin.drain()


async def _answer(process: asyncio.subprocess.Process) -> bytes:
    """What the process answers. Raises TwinStopped with its reason."""
    assert process.stdout is not None
    kind, length = HEAD.unpack(await process.stdout.readexactly(HEAD.size))
    content = await process.stdout.readexactly(length)
    if kind == b"X":
        raise TwinStopped(json.loads(content)["reason"])
    return content
