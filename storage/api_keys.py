"""API keys: shown once, kept as the SHA-256 of a token with 256 bits of entropy.

A fast hash is right here because a token, unlike a password, cannot be guessed.
"""

from __future__ import annotations

import hashlib
import secrets
from dataclasses import dataclass
from datetime import datetime
from typing import Literal, get_args

from sqlalchemy import select
from sqlalchemy.orm import Session

from schemas.base import Page
from schemas.ids import new_id
from storage.errors import Conflict, NotFound
from storage.pages import page_of
from storage.tables import ApiKeyRow, insert_if_absent, utc_now

Role = Literal["read", "write", "admin"]
ROLES: tuple[Role, ...] = get_args(Role)  # each holds the rights of those before it
TOKEN_PREFIX = "pw_"
TOKEN_BYTES = 32
MIN_TOKEN_LENGTH = 32


@dataclass(frozen=True)
class ApiKey:
    """A key without its token."""

    id: str
    name: str
    role: Role
    created_at: datetime
    revoked_at: datetime | None = None

    def allows(self, role: Role) -> bool:
        """Whether the key may do what ``role`` may."""
        return ROLES.index(self.role) >= ROLES.index(role)


def create_key(session: Session, name: str, role: Role) -> tuple[ApiKey, str]:
    """A new key and its token, which is never shown again."""
    token = TOKEN_PREFIX + secrets.token_urlsafe(TOKEN_BYTES)
    return ensure_key(session, token, name, role), token


def ensure_key(session: Session, token: str, name: str, role: Role) -> ApiKey:
    """Register a token that was made elsewhere (a deployment's secret); the same token twice is one key.

    Raises Conflict for a token that is too short, revoked, or known with another role.
    """
    if role not in ROLES:
        raise Conflict(f"role {role!r}; known: {', '.join(ROLES)}")
    if len(token) < MIN_TOKEN_LENGTH:
        raise Conflict(f"a token of {len(token)} characters; at least {MIN_TOKEN_LENGTH} are needed")
    values = {
        "id": new_id("key"),
        "name": name,
        "role": role,
        "digest": _digest(token),
        "created_at": utc_now(),
        "revoked_at": None,
    }
    insert_if_absent(session, ApiKeyRow, values)
    row = session.scalars(select(ApiKeyRow).where(ApiKeyRow.digest == _digest(token))).one()
    if row.revoked_at is not None or row.role != role:
        state = f"revoked at {row.revoked_at}" if row.revoked_at else f"of role {row.role}, not {role}"
        raise Conflict(f"the token is known as key {row.id}, {state}")
    return _key(row)


def verify(session: Session, token: str) -> ApiKey | None:
    """The key that the token belongs to, or None when it is unknown or revoked."""
    statement = select(ApiKeyRow).where(ApiKeyRow.digest == _digest(token), ApiKeyRow.revoked_at.is_(None))
    row = session.scalars(statement).one_or_none()
    return None if row is None else _key(row)


def get_active_key(session: Session, key_id: str) -> ApiKey | None:
    """The key with this id, or None when it is unknown or revoked (a browser's session keeps only the id)."""
    row = session.get(ApiKeyRow, key_id)
    return None if row is None or row.revoked_at is not None else _key(row)


def revoke_key(session: Session, key_id: str) -> ApiKey:
    """End a key; it stays listed. Raises NotFound."""
    row = session.get(ApiKeyRow, key_id)
    if row is None:
        raise NotFound("API key", key_id)
    row.revoked_at = row.revoked_at or utc_now()
    return _key(row)


def list_keys(session: Session, *, limit: int = 50, cursor: str | None = None) -> Page[ApiKey]:
    """Keys, newest first."""
    keys = (ApiKeyRow.created_at, ApiKeyRow.id)
    return page_of(session, select(ApiKeyRow), keys, _key, limit=limit, cursor=cursor)


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def _key(row: ApiKeyRow) -> ApiKey:
    role = next(role for role in ROLES if role == row.role)
    return ApiKey(row.id, row.name, role, row.created_at, row.revoked_at)
