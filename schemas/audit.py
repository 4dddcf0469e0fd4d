"""The audit log."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import Field

from physworld_schemas.base import Resource


class AuditEntry(Resource):
    """One change that matters to security.

    Attributes:
        actor: id of the API key that did it; null for a process on the service's own machine, and for strangers.
        address: where the request came from.
        action: what was done, e.g. ``key.revoked``.
        subject: to what: an id or a name.
    """

    seq: int = Field(description="Number of the entry; grows, never used twice.")
    at: datetime = Field(description="When, UTC.")
    actor: str | None = Field(
        default=None,
        description="API key that did it; null: a process of the service's machine, or a stranger.",
    )
    address: str | None = Field(default=None, description="Where the request came from.")
    action: str = Field(description="What was done.", examples=["key.revoked"])
    subject: str | None = Field(default=None, description="To what: an id or a name.")
    detail: dict[str, Any] = Field(default_factory=dict, description="What else is known of it.")
