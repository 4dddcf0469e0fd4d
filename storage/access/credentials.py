"""Credentials: the SHA-256 of what a request presented, a key's token or a browser's session.

Whatever lasts longer than its request, an event stream, a live session or a ticket, ends with the credential that
opened it. So one question is enough for revoked keys, keys whose term is over, tokens that were rotated away and
sessions that were logged out: whether the credential would still open it.
"""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy.orm import Session

from physworld_storage.access import api_keys, sessions
from physworld_storage.access.api_keys import ApiKey
from physworld_storage.tables import utc_now


def key_of(session: Session, credential: str) -> ApiKey | None:
    """The key behind a credential that is still good, else None."""
    return _standing(session, {credential}).get(credential)


def active(session: Session, credentials: Iterable[str]) -> set[str]:
    """Which of these credentials are still good."""
    return set(_standing(session, set(credentials)))


def _standing(session: Session, credentials: set[str]) -> dict[str, ApiKey]:
    now, found = utc_now(), dict[str, ApiKey]()
    for kind in (api_keys.standing, sessions.standing):
        for statement in kind(list(credentials - set(found)), now):
            if len(found) < len(credentials):
                rows = session.execute(statement)
                found |= {digest: api_keys.key_of_row(row, digest) for digest, row in rows}
    return found
