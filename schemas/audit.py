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

    seq: int
    at: datetime
    actor: str | None = None
    address: str | None = None
    action: str
    subject: str | None = None
    detail: dict[str, Any] = Field(default_factory=dict)
