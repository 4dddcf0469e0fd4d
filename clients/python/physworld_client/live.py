# Made of async_live.py by `make sdk`: change that file.
"""Live sessions with a published model: velocities out, frames in.

    with client.live.open("beam") as session:
        for frame in session:
            session.steer([0.0, 0.0, 0.1])      # m/s; lasts 0.3 s
            robot.show(frame.points)

A session ends with its block, or where the service ends it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Literal

from numpy.typing import ArrayLike
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection, connect

from physworld_client import live_frames
from physworld_client.base import Resource
from physworld_client.errors import ConnectionFailed
from physworld_client.live_frames import LiveFrame, LiveStart
from physworld_client.resources import LATEST
from physworld_client.transport import is_loopback
from physworld_schemas.rollout import Part
from physworld_schemas.wording import reason


class LiveSession:
    """One open session; an iterator over its frames.

    Frames that have arrived wait to be read: read them at the rate at which they come.

    Attributes:
        start: the body, the grips, the limits.
    """

    def __init__(self, socket: ClientConnection, start: LiveStart, timeout: float) -> None:
        self._socket, self._timeout, self._number = socket, timeout, 0
        self.start = start

    def steer(self, velocity: ArrayLike) -> int:
        """Sets velocities [m/s]: (3,) for every grip, (G, 3), or (K, 3) control points; they last 0.3 s.

        Returns:
            The number that frames bear in ``control`` from now on.

        Raises:
            ValueError: another shape, or a velocity that is no number.
            LiveSessionEnded: the session is over.
        """
        message = live_frames.write_control(self._number + 1, velocity, self.start)
        self._send(message)
        self._number += 1
        return self._number

    def frame(self) -> LiveFrame:
        """The next frame.

        Raises:
            LiveSessionEnded: the session is over.
            RequestTimedOut: none came within the client's timeout.
        """
        return live_frames.read_frame(live_frames.received(self._socket, self._timeout), self.start)

    def reset(self) -> None:
        """Puts the body back to its start; velocities that were set go on for their 0.3 s."""
        self._send(live_frames.RESET)

    def open_grips(self, grips: Iterable[int]) -> None:
        """Opens these grips from the next tick on, by their numbers from 0, and closes the others; a reset closes all.

        An open grip goes along with the material that it held, and closes where it is. The grips that hold must be
        one of the sets in ``start.holding``; the service ends the session where they are not.

        Raises:
            LiveSessionEnded: the session is over.
        """
        self._send(live_frames.write_open(grips))

    def set_factors(self, factors: Mapping[str, float], strengths: Mapping[str, float] | None = None) -> None:
        """Gives the body other properties from the next tick on, also after a reset.

        Args:
            factors: relative to the model's own, 0.01 to 100, by the names in ``start.factors``; one that is not given
                is as in the model. The service ends the session where it cannot take them.
            strengths: of effects, in their units and within their ranges, by the names in ``start.strengths``; one
                that is not given is the model's own.

        Raises:
            LiveSessionEnded: the session is over.
        """
        self._send(live_frames.write_factors(factors, strengths or {}))

    def _send(self, message: bytes | str) -> None:
        try:
            self._socket.send(message)
        except ConnectionClosed as error:
            raise live_frames.ended(error) from error

    def __iter__(self) -> Iterator[LiveFrame]:
        while True:
            yield self.frame()


class Live(Resource):
    """Bodies that answer while they are moved."""

    @contextmanager
    def open(
        self, model: str, version: int | str = LATEST, *, frames: int = 1, part: Part = "points"
    ) -> Iterator[LiveSession]:
        """Opens a session, which ends with the ``with`` block.

        Args:
            frames: 1 to 4 a tick, interpolated between ticks; the model's clock is near 30 Hz.
            part: "points" (measured points) or "vertices" (the graph's).

        Raises:
            NotFound: no such model or version.
            LiveSessionEnded: all sessions of the service are taken (``code`` 1013), or the version is of a layout that
                it does not read (1008).
            ConnectionFailed: no WebSocket could be opened.
        """
        ticket = self._client.send(live_frames.ticket_create(model, version))
        if not ticket.ticket:  # the first answer was lost on its way, and the replay of it holds none
            ticket = self._client.send(live_frames.ticket_create(model, version))
        where = live_frames.address(self._client.base_url, ticket, frames, part)
        proxy: Literal[True] | None = None if is_loopback(self._client.base_url) else True
        with ExitStack() as stack:
            try:
                line = connect(
                    where, open_timeout=self._client.timeout, max_size=live_frames.MOST_BYTES, proxy=proxy
                )
                socket = stack.enter_context(line)
            except (OSError, InvalidHandshake, TimeoutError) as error:
                raise ConnectionFailed(
                    f"no live session at {self._client.base_url}: {reason(error)}"
                ) from error
            start = live_frames.read_start(live_frames.received(socket, self._client.timeout))
            yield LiveSession(socket, start, self._client.timeout)
