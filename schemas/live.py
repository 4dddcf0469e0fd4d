"""Live sessions: tickets, and why a session is refused. Its messages are told in docs/rollouts.md."""

from __future__ import annotations

from datetime import datetime

from physworld_schemas.base import Request, Resource
from physworld_schemas.rollout import ModelName, Version

MOST_REASON_BYTES = 123  # RFC 6455, section 5.5: a control frame has 125, two of them the code's


class LiveTicketCreate(Request):
    """Body of POST /v1/live/tickets."""

    model: ModelName
    version: Version = "latest"


class LiveTicket(Resource):
    """A ticket for one connection; ``path`` is the WebSocket's address on this host, the ticket in it."""

    ticket: str
    model: str
    version: int
    expires_at: datetime
    path: str


def close_reason(code: str, detail: str) -> str:
    """A problem's code and detail as the reason of a closed WebSocket, cut to what fits."""
    text = f"{code}: {detail}"
    return text.encode()[:MOST_REASON_BYTES].decode(errors="ignore")
