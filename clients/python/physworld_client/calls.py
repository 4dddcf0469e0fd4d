"""One call of the REST API as plain data: method, path, query, body, and the type of the answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar, cast
from urllib.parse import quote

from pydantic import BaseModel

from physworld_client.bundle import Upload
from physworld_schemas.base import Page

Answer = TypeVar("Answer")
Item = TypeVar("Item", bound=BaseModel)


@dataclass(frozen=True)
class Call(Generic[Answer]):
    """One request and how to read its answer.

    Attributes:
        answer: its type; of an answer that is no JSON ``bytes``.
        form: text beside an upload.
        read_timeout_s: seconds that the service may hold the answer back on purpose (long poll).
    """

    method: str
    path: str
    answer: type[Answer]
    query: Mapping[str, str | int | float] = field(default_factory=dict)
    body: BaseModel | None = None
    upload: Upload | None = None
    form: Mapping[str, str] = field(default_factory=dict)
    read_timeout_s: float = 0.0


def route(*places: str | int) -> str:
    """``route("fits", id)`` is ``/v1/fits/{id}``; an id or a name can never leave its place in the path."""
    return "/".join(["/v1", *(quote(str(place), safe="") for place in places)])


def given(**values: str | int | float | None) -> dict[str, str | int | float]:
    """A query without the parameters that were not given."""
    return {name: value for name, value in values.items() if value is not None}


def page_of(item: type[Item]) -> type[Page[Item]]:
    """The type of a page of such items."""
    return cast("type[Page[Item]]", Page.__class_getitem__(item))
