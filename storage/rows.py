"""Rows by their ids: found, filled in while they are pending, ended; and the filters of a list."""

from __future__ import annotations

from typing import Any, TypeVar

from sqlalchemy import Select
from sqlalchemy.orm import InstrumentedAttribute, Session

from physworld_schemas.base import Artifact, Unmade
from physworld_storage.errors import Conflict, NotFound
from physworld_storage.tables import Base, JsonList, Made

Row = TypeVar("Row", bound=Base)
MadeRow = TypeVar("MadeRow", bound=Made)


def required(session: Session, table: type[Row], identifier: str) -> Row:
    """The row, or NotFound."""
    row = session.get(table, identifier)
    if row is None:
        raise NotFound(table.noun, identifier)
    return row


def pending(session: Session, table: type[MadeRow], identifier: str) -> MadeRow:
    """The row of what is to be filled in. Raises NotFound, or Conflict when it is not pending."""
    row = required(session, table, identifier)
    if row.state != "pending":
        raise Conflict(
            f"{table.noun} {identifier} is {row.state}; only a pending {table.noun} can become ready"
        )
    return row


def end_pending(session: Session, table: type[Made], identifier: str, state: Unmade) -> None:
    """Mark what is pending failed or cancelled; what is ready stays as it is. Raises NotFound.

    Args:
        session: the transaction that ends its job.
        table: whose row.
        identifier: of the row.
        state: from now on.
    """
    row = required(session, table, identifier)
    if row.state == "pending":
        row.state = state


def chosen(
    statement: Select[Row], *filters: tuple[InstrumentedAttribute[Any], str | int | None]
) -> Select[Row]:
    """The rows whose columns have the values; None chooses nothing."""
    for column, value in filters:
        if value is not None:
            statement = statement.where(column == value)
    return statement


def plain(artifacts: list[Artifact]) -> JsonList:
    """Artifacts as a column holds them."""
    return [artifact.model_dump(mode="json") for artifact in artifacts]
