"""Live sessions: tickets. The messages of a session are told in docs/rollouts.md."""

from __future__ import annotations

from datetime import datetime

from schemas.base import Request, Resource
from schemas.rollout import ModelName, Version


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
