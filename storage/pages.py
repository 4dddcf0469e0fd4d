"""Cursor pages: a cursor is the sort key of the last row given out, so a page never shifts under writers."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any, TypeVar

from sqlalchemy import Select, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

from physworld_schemas.base import Page, holds_unstorable_characters
from physworld_storage.errors import InvalidCursor
from physworld_storage.tables import Base

MAX_LIMIT = 1000
LARGEST_KEY = 2**31 - 1
Row = TypeVar("Row", bound=Base)
Item = TypeVar("Item")


def page_of(
    session: Session,
    statement: Select[Row],
    keys: Sequence[InstrumentedAttribute[Any]],
    convert: Callable[[Row], Item],
    *,
    limit: int,
    cursor: str | None,
    ascending: bool = False,
) -> Page[Item]:
    """One page of ``statement`` sorted by ``keys`` (together unique), newest first unless ``ascending``.

    Args:
        session: the transaction that reads.
        statement: which rows, unsorted.
        keys: columns to sort by, together unique; the cursor holds the last row's.
        convert: a row to what the page holds.
        limit: most items, 1 to ``MAX_LIMIT``; more are cut down to it.
        cursor: of the page before; None begins at the beginning.
        ascending: smallest keys first.

    Raises:
        InvalidCursor: this kind of list never gave the cursor out.
    """
    limit = max(1, min(limit, MAX_LIMIT))
    if cursor is not None:
        place = tuple_(*(_decode(cursor, keys)))
        statement = statement.where(tuple_(*keys) > place if ascending else tuple_(*keys) < place)
    order = [key.asc() if ascending else key.desc() for key in keys]
    rows = list(session.scalars(statement.order_by(*order).limit(limit + 1)))
    has_more = len(rows) > limit
    rows = rows[:limit]
    last = [getattr(rows[-1], key.key) for key in keys] if has_more else None
    return Page(
        data=[convert(row) for row in rows],
        has_more=has_more,
        next_cursor=_encode(last) if last is not None else None,
    )


def _encode(values: Sequence[Any]) -> str:
    plain = [value.isoformat() if isinstance(value, datetime) else value for value in values]
    return base64.urlsafe_b64encode(json.dumps(plain).encode()).decode().rstrip("=")


def _decode(cursor: str, keys: Sequence[InstrumentedAttribute[Any]]) -> list[Any]:
    try:
        plain = json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
        return [_typed(value, key) for value, key in zip(plain, keys, strict=True)]
    except (binascii.Error, ValueError, TypeError, OverflowError) as error:
        raise InvalidCursor(f"cursor {cursor[:64]!r} does not come from this list") from error


def _typed(value: Any, key: InstrumentedAttribute[Any]) -> Any:
    wanted = key.type.python_type
    if wanted is datetime:
        moment = datetime.fromisoformat(value)
        if moment.tzinfo is None:
            raise ValueError("a cursor's time without a zone")
        return moment.astimezone(UTC)
    if type(value) is not wanted:
        raise TypeError(f"{key.key} is not a {wanted.__name__}")
    if isinstance(value, int) and abs(value) > LARGEST_KEY:
        raise ValueError(f"{key.key} is larger than any")
    if isinstance(value, str) and holds_unstorable_characters(value):
        raise ValueError(f"{key.key} holds what no text here does")
    return value
