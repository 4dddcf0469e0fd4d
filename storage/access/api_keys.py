"""API keys: shown once, kept as the SHA-256 of a token with 256 bits of entropy.

A fast hash is right here because a token, unlike a password, cannot be guessed. A key is good until it is revoked or
its term is over. Rotation gives it another token; the old one stays good for a while and is remembered for ever, so
that a token that was rotated away never becomes a key again.

The SHA-256 of what somebody presented (a token, or a browser's session) is the *credential* of the request
(``physworld_storage.access.credentials``).
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Literal, get_args

from sqlalchemy import ColumnElement, Select, and_, bindparam, or_, select, update
from sqlalchemy.orm import Session

from physworld_schemas.base import Page
from physworld_schemas.ids import new_id
from physworld_storage.access import audit
from physworld_storage.access.audit import LOCAL, Actor
from physworld_storage.errors import Conflict, KeyEnded, NotFound
from physworld_storage.pages import page_of
from physworld_storage.search import matching
from physworld_storage.tables import ApiKeyRow, RetiredTokenRow, SessionRow, insert_if_absent, utc_now

Role = Literal["read", "write", "admin"]
ROLES: tuple[Role, ...] = get_args(Role)  # each holds the rights of those before it
TOKEN_PREFIX = "pw_"
TOKEN_BYTES = 32
MIN_TOKEN_LENGTH = 32
_BY_TOKEN = select(ApiKeyRow).where(ApiKeyRow.digest == bindparam("digest"))
_NEVER = datetime.max.replace(tzinfo=UTC)


@dataclass(frozen=True)
class ApiKey:
    """A key without its token.

    Attributes:
        lifetime_days: the term that a rotation gives it again; None has no end.
        credential: SHA-256 of what this key was known by: its token, an older one, or a session.
    """

    id: str
    name: str
    role: Role
    created_at: datetime
    expires_at: datetime | None = None
    revoked_at: datetime | None = None
    lifetime_days: int | None = None
    credential: str = field(default="", repr=False, compare=False)

    def allows(self, role: Role) -> bool:
        """Whether the key may do what ``role`` may."""
        return ROLES.index(self.role) >= ROLES.index(role)


def create_key(
    session: Session, name: str, role: Role, *, lifetime_days: int | None = None, by: Actor = LOCAL
) -> tuple[ApiKey, str]:
    """A new key and its token, which is never shown again.

    Args:
        session: the transaction that it belongs to.
        name: who or what uses the key, for people.
        role: one of ``ROLES``.
        lifetime_days: days until it ends, and the term that a rotation gives it again; None has no end.
        by: who makes it, for the audit log.

    Raises:
        Conflict: an unknown role.
    """
    token = _new_token()
    return ensure_key(session, token, name, role, lifetime_days=lifetime_days, by=by), token


def ensure_key(
    session: Session,
    token: str,
    name: str,
    role: Role,
    *,
    lifetime_days: int | None = None,
    by: Actor = LOCAL,
) -> ApiKey:
    """Register a token that was made elsewhere (a deployment's secret); the same token twice is one key.

    Args:
        session: the transaction that it belongs to.
        token: at least ``MIN_TOKEN_LENGTH`` characters; only its SHA-256 is stored.
        name: who or what uses the key, for people.
        role: one of ``ROLES``.
        lifetime_days: days until it ends; None has no end. A token that is known keeps its own.
        by: who makes it, for the audit log.

    Raises:
        KeyEnded: the token's key was revoked, has expired or has another token now.
        Conflict: the token is too short or known with another role, or the role is unknown.
    """
    if role not in ROLES:
        raise Conflict(f"role {role!r}; known: {', '.join(ROLES)}")
    if len(token) < MIN_TOKEN_LENGTH:
        raise Conflict(f"a token of {len(token)} characters; at least {MIN_TOKEN_LENGTH} are needed")
    now = utc_now()
    retired = session.get(RetiredTokenRow, digest_of(token))
    if retired is not None:
        raise KeyEnded(f"the token belonged to key {retired.key_id}, which was given another one by rotation")
    values = {
        "id": new_id("key"),
        "name": name,
        "role": role,
        "digest": digest_of(token),
        "created_at": now,
        "expires_at": _end_of(now, lifetime_days),
        "lifetime_days": lifetime_days,
        "revoked_at": None,
    }
    made = insert_if_absent(session, ApiKeyRow, values)
    row = session.scalars(select(ApiKeyRow).where(ApiKeyRow.digest == digest_of(token))).one()
    if made:
        end = row.expires_at.isoformat() if row.expires_at else None
        audit.record(session, by, "key.created", row.id, name=name, role=role, expires_at=end)
    if not _stands(row, now):
        raise KeyEnded(f"the token is known as key {row.id}, {_state(row)}")
    if row.role != role:
        raise Conflict(f"the token is known as key {row.id}, of role {row.role}, not {role}")
    return key_of_row(row)


def verify(session: Session, token: str) -> ApiKey | None:
    """The key that the token belongs to; None when it is unknown, rotated away, or its key revoked or expired.

    One query for the token of a key, prepared because every request asks it; one more for what is none.
    """
    digest = digest_of(token)
    row = session.scalars(_BY_TOKEN, {"digest": digest}).one_or_none()
    if row is not None:
        return key_of_row(row, digest) if _stands(row, utc_now()) else None
    _, older = standing([digest], utc_now())
    found = session.execute(older).one_or_none()
    return None if found is None else key_of_row(found[1], digest)


def standing(credentials: Sequence[str], now: datetime) -> tuple[Select[str, ApiKeyRow], ...]:
    """Queries for the good ones among these credentials with their keys: tokens, then older ones in their grace."""
    older = RetiredTokenRow
    return (
        select(ApiKeyRow.digest, ApiKeyRow).where(ApiKeyRow.digest.in_(credentials), is_active(now)),
        select(older.digest, ApiKeyRow)
        .join(ApiKeyRow, ApiKeyRow.id == older.key_id)
        .where(older.digest.in_(credentials), older.valid_until > now, is_active(now)),
    )


def rotate_key(
    session: Session, key_id: str, grace: timedelta, *, by: Actor = LOCAL
) -> tuple[ApiKey, str, datetime]:
    """Give a key another token and its whole term again: the key, the token, and when the old token ends.

    Sessions that the old token opened end with it. Tokens from rotations before end now, whatever their grace was.

    Args:
        session: the transaction that it belongs to.
        key_id: of a key that stands.
        grace: how long the old token is taken beside the new one.
        by: who rotates it, for the audit log.

    Raises:
        NotFound: there is no such key.
        Conflict: the key was revoked or has expired.
    """
    now = utc_now()
    row = _locked(session, key_id)
    if not _stands(row, now):
        raise Conflict(f"key {key_id} is {_state(row)}; make another one")
    until, token = now + grace, _new_token()
    for older in session.scalars(select(RetiredTokenRow).where(RetiredTokenRow.key_id == key_id)):
        older.valid_until = min(older.valid_until, now)
    session.add(RetiredTokenRow(digest=row.digest, key_id=key_id, valid_until=until))
    opened = update(SessionRow).where(SessionRow.key_id == key_id, SessionRow.expires_at > until)
    session.execute(opened.values(expires_at=until))
    row.digest, row.expires_at = digest_of(token), _end_of(now, row.lifetime_days)
    audit.record(session, by, "key.rotated", key_id, old_token_until=until.isoformat())
    session.flush()
    return key_of_row(row), token, until


def revoke_key(session: Session, key_id: str, *, by: Actor = LOCAL) -> ApiKey:
    """End a key; it stays listed. Raises NotFound, or Conflict for the admin key that would live longest.

    That one key nobody can end, so there is an administrator until the last term is over. Every admin key is locked
    while this is decided: of two that revoke each other at once, one stays.
    """
    now = utc_now()
    admins = select(ApiKeyRow).where(ApiKeyRow.role == "admin", is_active(now)).order_by(ApiKeyRow.id)
    locking = admins.with_for_update().execution_options(populate_existing=True)
    others = [row for row in session.scalars(locking) if row.id != key_id]
    row = _locked(session, key_id)
    if row.role == "admin" and _stands(row, now):
        longest = max((_end(other) for other in others), default=None)
        if longest is None or longest < _end(row):
            others_end = f"{len(others)} others end before it" if others else "there is no other"
            raise Conflict(
                f"key {key_id} is the admin key that lives longest ({_words(row.expires_at)}; {others_end}): without "
                "it nobody could make keys. Make another admin key with no earlier end first, or rotate this one"
            )
    if row.revoked_at is None:
        row.revoked_at = now
        audit.record(session, by, "key.revoked", key_id, name=row.name, role=row.role)
        session.flush()
    return key_of_row(row)


def list_keys(
    session: Session, *, limit: int = 50, cursor: str | None = None, search: str | None = None
) -> Page[ApiKey]:
    """Keys, newest first.

    Args:
        session: the transaction that reads.
        limit: most keys of a page, 1 to ``pages.MAX_LIMIT``.
        cursor: of the page before; None begins with the newest.
        search: words that an id, a name or a role holds.

    Raises:
        InvalidCursor: no list of keys gave this cursor out.
    """
    statement = matching(select(ApiKeyRow), search, ApiKeyRow.id, ApiKeyRow.name, ApiKeyRow.role)
    keys = (ApiKeyRow.created_at, ApiKeyRow.id)
    return page_of(session, statement, keys, key_of_row, limit=limit, cursor=cursor)


def names_of(session: Session, ids: Iterable[str]) -> dict[str, str]:
    """Names of these keys by their ids; unknown ones are left out."""
    rows = session.execute(select(ApiKeyRow.id, ApiKeyRow.name).where(ApiKeyRow.id.in_(set(ids))))
    return {row.id: row.name for row in rows}


def count_active_admins(session: Session) -> int:
    """How many admin keys are good now."""
    return len(
        list(session.scalars(select(ApiKeyRow.id).where(ApiKeyRow.role == "admin", is_active(utc_now()))))
    )


def digest_of(secret: str) -> str:
    """The credential of a token or a session's text."""
    return hashlib.sha256(secret.encode()).hexdigest()


def _new_token() -> str:
    return TOKEN_PREFIX + secrets.token_urlsafe(TOKEN_BYTES)


def _end_of(start: datetime, lifetime_days: int | None) -> datetime | None:
    return None if lifetime_days is None else start + timedelta(days=lifetime_days)


def is_active(now: datetime) -> ColumnElement[bool]:
    """The condition that a key is neither revoked nor expired."""
    return and_(
        ApiKeyRow.revoked_at.is_(None), or_(ApiKeyRow.expires_at.is_(None), ApiKeyRow.expires_at > now)
    )


def _stands(row: ApiKeyRow, now: datetime) -> bool:
    return row.revoked_at is None and _end(row) > now


def _end(row: ApiKeyRow) -> datetime:
    return row.expires_at or _NEVER


def _state(row: ApiKeyRow) -> str:
    return f"revoked at {row.revoked_at}" if row.revoked_at else f"expired at {row.expires_at}"


def _words(end: datetime | None) -> str:
    return "it never ends" if end is None else f"it ends at {end.isoformat(timespec='seconds')}"


def _locked(session: Session, key_id: str) -> ApiKeyRow:
    statement = select(ApiKeyRow).where(ApiKeyRow.id == key_id).with_for_update()
    row = session.scalars(statement.execution_options(populate_existing=True)).one_or_none()
    if row is None:
        raise NotFound("API key", key_id)
    return row


def key_of_row(row: ApiKeyRow, credential: str | None = None) -> ApiKey:
    """The key in a row, known by its own token unless another credential is named."""
    role = next(role for role in ROLES if role == row.role)
    return ApiKey(
        row.id,
        row.name,
        role,
        row.created_at,
        row.expires_at,
        row.revoked_at,
        row.lifetime_days,
        credential or row.digest,
    )
