"""Messages of a live session as arrays, shared by both clients; ``docs/rollouts.md`` has the bytes."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from urllib.parse import urlencode

import numpy as np
from numpy.typing import ArrayLike
from websockets.asyncio.client import ClientConnection as AsyncClientConnection
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from physworld_client.calls import Call
from physworld_client.errors import LiveSessionEnded, PhysWorldError, RequestTimedOut
from physworld_client.types import Array
from physworld_schemas.live import LiveTicket, LiveTicketCreate
from physworld_schemas.rollout import Part
from physworld_schemas.wording import reason

MOST_BYTES = 64 * 2**20
"""Of one message; the first one lists the body's points as text."""
RESET = json.dumps({"type": "reset"})
_HEAD = struct.Struct("<IIfI")
_SET_BACK = 1


@dataclass(frozen=True)
class LiveStrength:
    """A strength of an effect that a session can change.

    Attributes:
        name: the effect and its strength, or ``ground.friction``.
        unit: SI unit of the others.
        low, high: the range that the model's training covered.
        value: the model's own.
    """

    name: str
    unit: str
    low: float
    high: float
    value: float


@dataclass(frozen=True)
class LiveStart:
    """What holds for the whole session.

    Attributes:
        dt_s: the model's time step [s].
        points: the body where the session begins [m], (N, 3).
        controllers: control points there [m], (K, 3).
        grips: which control points move as one body, G groups of numbers.
        speed_m_s: speeds beyond are cut.
        reach_m: a grip stops that far from its start, along each axis.
        holding: the sets of grips that can hold, by their numbers; more than one where grips can let go.
        factors: properties that can be changed; none where the service is older than they are.
        strengths: of effects, those that the model was trained over.
    """

    dt_s: float
    points: Array
    controllers: Array
    grips: tuple[tuple[int, ...], ...]
    speed_m_s: float
    reach_m: float
    holding: tuple[tuple[int, ...], ...] = ()
    factors: tuple[str, ...] = ()
    strengths: tuple[LiveStrength, ...] = ()


@dataclass(frozen=True)
class LiveFrame:
    """One frame.

    Attributes:
        tick: of the model's clock, 0 at the start.
        control: number of the last velocities that the service had read (``steer`` gives them).
        time_s: since the start.
        set_back: the prediction had left the numbers and was set back to its start.
        points: (N, 3) [m]. controllers: (K, 3) [m].
    """

    tick: int
    control: int
    time_s: float
    set_back: bool
    points: Array
    controllers: Array


def ticket_create(model: str, version: int | str) -> Call[LiveTicket]:
    """The ticket of one connection."""
    body = LiveTicketCreate.model_validate({"model": model, "version": version})
    return Call("POST", "/v1/live/tickets", LiveTicket, body=body)


def address(base_url: str, ticket: LiveTicket, frames: int, part: Part) -> str:
    """The WebSocket's address, ``frames`` a tick.

    Args:
        base_url: of the service, ``http`` or ``https``.
        ticket: admits one session.
        frames: sent for every tick of the model, 1 to 4; those between are interpolated.
        part: whether vertices or points are sent.

    Raises:
        ValueError: another number of frames.
    """
    if frames not in (1, 2, 3, 4):
        raise ValueError(f"frames is {frames}: a session sends 1 to 4 of them a tick")
    query = urlencode({"frames": frames, "part": part})
    return f"{base_url.replace('http', 'ws', 1)}{ticket.path}&{query}"


def write_factors(factors: Mapping[str, float], strengths: Mapping[str, float]) -> str:
    """Properties of the body relative to the model's, and strengths of effects in their units, by name."""
    named = {name: float(factor) for name, factor in factors.items()}
    message: dict[str, object] = {"type": "factors", "factors": named}
    if strengths:
        message["strengths"] = {name: float(value) for name, value in strengths.items()}
    return json.dumps(message)


def write_open(grips: Iterable[int]) -> str:
    """Grips that are to be open, by their numbers; the others hold."""
    return json.dumps({"type": "open", "grips": [int(grip) for grip in grips]})


def read_start(message: bytes | str) -> LiveStart:
    """The first message. Raises PhysWorldError where it is another one."""
    try:
        ready = json.loads(message)
        return LiveStart(
            dt_s=float(ready["dt_s"]),
            points=np.array(ready["start"], dtype=np.float64).reshape(-1, 3),
            controllers=np.array(ready["controllers"], dtype=np.float64).reshape(-1, 3),
            grips=tuple(tuple(int(number) for number in grip) for grip in ready["grips"]),
            speed_m_s=float(ready["speed_m_s"]),
            reach_m=float(ready["reach_m"]),
            holding=tuple(tuple(int(number) for number in grips) for grips in ready.get("holding", ())),
            factors=tuple(map(str, ready.get("factors", ()))),
            strengths=tuple(
                LiveStrength(one["name"], one["unit"], *(float(one[key]) for key in ("low", "high", "value")))
                for one in ready.get("strengths", ())
            ),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise PhysWorldError(f"a live session began with {message[:120]!r}: {reason(error)}") from error


def read_frame(message: bytes | str, start: LiveStart) -> LiveFrame:
    """A binary message. Raises PhysWorldError where its size is not that of the session's frames."""
    expected = _HEAD.size + 12 * (len(start.points) + len(start.controllers))
    if isinstance(message, str) or len(message) != expected:
        raise PhysWorldError(f"a live session sent {len(message)} bytes for a frame of {expected}")
    tick, control, time_s, flags = _HEAD.unpack_from(message)
    places = np.frombuffer(message, "<f4", offset=_HEAD.size).reshape(-1, 3).astype(np.float64)
    points, controllers = np.split(places, [len(start.points)])
    return LiveFrame(tick, control, time_s, bool(flags & _SET_BACK), points, controllers)


def write_control(number: int, velocity: ArrayLike, start: LiveStart) -> bytes:
    """The message that steers. ``velocity`` [m/s]: (3,) for every grip, (G, 3), or (K, 3).

    Raises:
        ValueError: another shape, or a velocity that is no number.
    """
    rows = np.asarray(velocity, dtype=np.float64)
    if rows.shape == (3,):
        rows = np.tile(rows, (len(start.grips), 1))
    if rows.shape not in {(len(start.grips), 3), (len(start.controllers), 3)}:
        raise ValueError(
            f"velocities of shape {rows.shape}; a session of {len(start.grips)} grips and "
            f"{len(start.controllers)} control points takes (3,), ({len(start.grips)}, 3) or "
            f"({len(start.controllers)}, 3)"
        )
    if not np.isfinite(rows).all():
        raise ValueError(f"{np.count_nonzero(~np.isfinite(rows))} velocities are no finite number")
    return struct.pack("<I", number) + rows.astype("<f4").tobytes()


def ended(error: ConnectionClosed) -> LiveSessionEnded:
    """Why the service, or the line, ended the session."""
    close = error.rcvd or error.sent
    return LiveSessionEnded(close.code if close else 1006, close.reason if close else "the line broke")


def received(socket: ClientConnection, timeout: float) -> bytes | str:
    """The next message of a session, within so many seconds."""
    try:
        return socket.recv(timeout=timeout)
    except (ConnectionClosed, TimeoutError) as error:
        raise _not_received(error, timeout) from error


async def received_async(socket: AsyncClientConnection, timeout: float) -> bytes | str:
    """The same, awaited: the one call that differs between the two kinds of sockets by more than a word."""
    try:
        async with asyncio.timeout(timeout):
            return await socket.recv()
    except (ConnectionClosed, TimeoutError) as error:
        raise _not_received(error, timeout) from error


def _not_received(error: ConnectionClosed | TimeoutError, timeout: float) -> PhysWorldError:
    if isinstance(error, ConnectionClosed):
        return ended(error)
    return RequestTimedOut(f"a live session sent nothing within {timeout:g} s")
