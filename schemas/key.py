"""API keys."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from schemas.base import Request, Resource

Role = Literal["read", "write", "admin"]


class KeyCreate(Request):
    """Body of POST /v1/keys."""

    name: str = Field(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f]*$")
    role: Role = "read"


class ApiKey(Resource):
    """An API key; ``token`` is given once, in the answer that creates it, and is not stored."""

    id: str
    name: str
    role: Role
    created_at: datetime
    revoked_at: datetime | None = None
    token: str | None = None
