"""Live sessions: tickets, and why a session is refused. Its messages are told in docs/rollouts.md."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from physworld_schemas.base import Request, Resource
from physworld_schemas.rollout import ModelName, Version

MOST_REASON_BYTES = 123  # RFC 6455, section 5.5: a control frame has 125, two of them the code's


class LiveTicketCreate(Request):
    """Body of POST /v1/live/tickets."""

    model: ModelName = Field(description="Name of the model.", examples=["soft_beam"])
    version: Version = Field(default="latest", description="Number, alias or `latest`.")


class LiveTicket(Resource):
    """A ticket for one connection; ``path`` is the WebSocket's address on this host, the ticket in it."""

    ticket: str = Field(description="Secret for one connection.")
    model: str = Field(description="Name of the model.", examples=["soft_beam"])
    version: int = Field(description="Version of the model.")
    expires_at: datetime = Field(description="When it ends.")
    path: str = Field(description="Address of the WebSocket on this host, ticket included.")


def close_reason(code: str, detail: str) -> str:
    """A problem's code and detail as the reason of a closed WebSocket, cut to what fits."""
    text = f"{code}: {detail}"
    return text.encode()[:MOST_REASON_BYTES].decode(errors="ignore")
