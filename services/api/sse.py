"""The event stream of a job as an answer (server-sent events); ``physworld_services.api.feed`` has the events.

Each event carries its ``seq`` as the SSE id; a client that reconnects with ``Last-Event-ID`` misses nothing
and sees nothing twice. The stream ends after the event that ends the job, or when the server stops (the
client connects again). A comment every 15 s keeps proxies from closing the connection.
"""

from __future__ import annotations

from collections.abc import AsyncIterator

import anyio
from sse_starlette import EventSourceResponse, ServerSentEvent

STREAMED = {
    "type": "object",
    "required": ["id", "event", "data"],
    "properties": {
        "id": {"type": "string", "description": "The event's `seq`.", "pattern": "^[0-9]+$"},
        "event": {
            "type": "string",
            "description": "The event's `type`.",
            "enum": ["state", "progress", "log"],
        },
        "data": {
            "type": "string",
            "description": "The event as JSON.",
            "contentMediaType": "application/json",
            "contentSchema": {"$ref": "#/components/schemas/Event"},
        },
    },
}
"""How the OpenAPI document describes each event of the stream."""
HEARTBEAT_S = 15
CLOSING_S = 2.0  # for the streams to end by themselves when the server stops


def event_response(messages: AsyncIterator[ServerSentEvent]) -> EventSourceResponse:
    """The stream of these messages."""
    return EventSourceResponse(
        messages,
        ping=HEARTBEAT_S,
        ping_message_factory=lambda: ServerSentEvent(comment="heartbeat"),
        shutdown_event=anyio.Event(),
        shutdown_grace_period=CLOSING_S,
    )
