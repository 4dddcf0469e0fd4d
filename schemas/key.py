"""API keys."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from physworld_schemas.base import Request, Resource

Role = Literal["read", "write", "admin"]

DEFAULT_LIFETIME_DAYS = 365
MAX_LIFETIME_DAYS = 3650
DEFAULT_GRACE_MINUTES = 60
MAX_GRACE_MINUTES = 7 * 24 * 60


class KeyCreate(Request):
    """Body of POST /v1/keys."""

    name: str = Field(
        min_length=1,
        max_length=100,
        pattern=r"^[^\x00-\x1f]*$",
        description="Who or what uses the key.",
        examples=["robot-1"],
    )
    role: Role = Field(
        default="read", description="What it may do: read; read and write; or also manage keys."
    )
    expires_in_days: int | None = Field(
        default=DEFAULT_LIFETIME_DAYS, ge=1, le=MAX_LIFETIME_DAYS, description="null: it never expires"
    )


class KeyRotate(Request):
    """Body of POST /v1/keys/{key_id}/rotate."""

    grace_minutes: int = Field(
        default=DEFAULT_GRACE_MINUTES,
        ge=0,
        le=MAX_GRACE_MINUTES,
        description="how long the old token stays good; 0 ends it, and what it opened, at once",
    )


class ApiKey(Resource):
    """An API key; ``token`` is given once, in the answer that makes it, and is not stored.

    ``old_token_until`` is in the answer of a rotation: when the token before ends.
    """

    id: str = Field(description="Identifier: a prefix of its kind and 26 characters that sort by time.")
    name: str = Field(description="Who or what uses it.")
    role: Role = Field(description="What it may do.")
    created_at: datetime = Field(description="When it was made, UTC.")
    expires_at: datetime | None = Field(default=None, description="When it ends; null: never.")
    revoked_at: datetime | None = Field(default=None, description="When it was ended; null: it stands.")
    token: str | None = Field(default=None, description="The secret, given once; null in every other answer.")
    old_token_until: datetime | None = Field(
        default=None, description="When the token before ends, after a rotation."
    )
