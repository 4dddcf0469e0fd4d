"""Idempotency-Key: the first answer is kept and replayed; the same key with another body is refused.

::

    with database.session() as session:
        answer = idempotency.reserve(session, key_id, header, fingerprint(method, path, body))
        if answer is None:
            …do the work in this same transaction…
            idempotency.record(session, key_id, header, Answer(202, headers, body))

Reservation, work and answer commit together or not at all, so a process killed in between leaves nothing and
the client's second try is a first one. Of two requests at the same time the second waits for the first.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, cast

from sqlalchemy import CursorResult, and_, delete, func
from sqlalchemy.orm import Session

from physworld_storage.errors import Conflict, IdempotencyMismatch, NotFound
from physworld_storage.tables import IdempotencyRow, insert_if_absent, utc_now

MAX_KEY_LENGTH = 255


@dataclass(frozen=True)
class Answer:
    """What was answered: status, the headers worth repeating (Location, …), body."""

    status: int
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""


def fingerprint(method: str, path: str, body: bytes) -> str:
    """What makes two requests the same one."""
    head = f"{method.upper()} {path}\n".encode()
    return hashlib.sha256(head + body).hexdigest()


def reserve(session: Session, owner: str, key: str, fingerprint: str) -> Answer | None:
    """None: the key is new, do the work. An answer: repeat it.

    Args:
        session: the transaction that does the work.
        owner: of the key: equal keys of two owners are two keys.
        key: as the client sent it, 1 to ``MAX_KEY_LENGTH`` characters.
        fingerprint: of the request; a repetition has the same.

    Raises:
        IdempotencyMismatch: the key came with another request before.
        Conflict: the key is too long, or the work of the first request was committed without an answer.
    """
    if not 0 < len(key) <= MAX_KEY_LENGTH:
        raise Conflict(f"an Idempotency-Key of {len(key)} characters; 1 to {MAX_KEY_LENGTH} are allowed")
    values = {"owner": owner, "key": key, "fingerprint": fingerprint, "created_at": utc_now()}
    if insert_if_absent(session, IdempotencyRow, values):
        return None
    row = _row(session, owner, key)
    if row.fingerprint != fingerprint:
        raise IdempotencyMismatch(f"Idempotency-Key {key!r} was used for another request at {row.created_at}")
    if row.status is None:
        raise Conflict(f"the request with Idempotency-Key {key!r} has not been answered")
    return Answer(row.status, dict(row.headers or {}), row.body or b"")


def record(session: Session, owner: str, key: str, answer: Answer) -> None:
    """Keep the answer to a reserved key, in the transaction that does the work.

    Args:
        session: the transaction that does the work.
        owner: of the key.
        key: from ``reserve``.
        answer: what every repetition gets.
    """
    row = _row(session, owner, key)
    row.status = answer.status
    row.headers = dict(answer.headers)
    row.body = answer.body
    session.flush()


def forget(session: Session, before: datetime, larger_than: int = -1) -> int:
    """Drop keys older than ``before`` whose answer has more than ``larger_than`` bytes; how many."""
    old = IdempotencyRow.created_at < before
    if larger_than >= 0:
        old = and_(old, func.length(IdempotencyRow.body) > larger_than)
    result = session.execute(delete(IdempotencyRow).where(old))
    return cast("CursorResult[Any]", result).rowcount


def _row(session: Session, owner: str, key: str) -> IdempotencyRow:
    row = session.get(IdempotencyRow, (owner, key), populate_existing=True)
    if row is None:
        raise NotFound("Idempotency-Key", key)
    return row
