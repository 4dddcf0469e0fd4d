"""Server-sent events of a job, decoded line by line (the subset of the format that the service sends)."""

from __future__ import annotations

from pydantic import ValidationError

from physworld_client.errors import PhysWorldError
from physworld_client.types import Event
from physworld_schemas.job import TERMINAL_STATES

HEARTBEAT_S = 15.0
IDLE_LIMIT_S = 3 * HEARTBEAT_S
"""Silence after which a stream counts as broken: the service sends a comment every ``HEARTBEAT_S``."""


class EventDecoder:
    """Lines in, events out; remembers the last id for the resumption."""

    def __init__(self, last_id: int | None = None) -> None:
        self.last_id = last_id
        self._data: list[str] = []

    def headers(self) -> dict[str, str]:
        """Request headers that resume after the last event seen."""
        headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
        if self.last_id is not None:
            headers["Last-Event-ID"] = str(self.last_id)
        return headers

    def reset(self) -> None:
        """Forgets an event that was cut in the middle, before a reconnection."""
        self._data.clear()

    def feed(self, line: str) -> Event | None:
        """Takes one line without its end; returns an event when the line ends one."""
        if line:
            name, _, value = line.partition(":")
            if name == "data":
                self._data.append(value.removeprefix(" "))
            return None
        if not self._data:
            return None
        text = "\n".join(self._data)
        self._data.clear()
        try:
            event = Event.model_validate_json(text)
        except ValidationError as error:
            raise PhysWorldError(
                f"the event stream holds an event that cannot be read: {text[:200]}"
            ) from error
        self.last_id = event.seq
        return event


def ends_job(event: Event, job_id: str) -> bool:
    """Whether this event is the end of the job."""
    return event.job_id == job_id and event.type == "state" and event.data.get("state") in TERMINAL_STATES
