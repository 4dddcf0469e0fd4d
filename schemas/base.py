"""Base classes of the wire models: strict about unknown fields on input, tolerant on output."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

ObjectKind = Literal["scene", "fit", "trace", "dataset", "model", "assessment", "rollout", "plan", "artifact"]
_UNSTORABLE = re.compile("[\0\ud800-\udfff]")
_PLAIN = frozenset({float, int, bool, type(None)})
Seed = Annotated[int, Field(ge=0, lt=2**63)]


class Request(BaseModel):
    """A body that a client sends: an unknown field is an error, not a silent typo."""

    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _storable(cls, value: Any) -> Any:
        """Refuse text that Postgres keeps neither as text nor in JSON: NUL, and halves of surrogate pairs."""
        if _holds_unstorable(value):
            raise ValueError("holds a NUL character or half of a surrogate pair")
        return value


class Resource(BaseModel):
    """An object that the service returns: a newer service may add fields."""

    model_config = ConfigDict(extra="ignore")


class Reference(Resource):
    """One input of an object: what it was made from, and the digest it had then."""

    kind: ObjectKind
    id: str
    digest: str | None = None


class Lineage(Resource):
    """What made an object; the same inputs, code and configuration make it again."""

    inputs: list[Reference] = Field(default_factory=list)
    code_version: str = ""
    config_digest: str = ""
    seeds: dict[str, int] = Field(default_factory=dict)
    device: str = ""
    job_id: str | None = None


class Artifact(Resource):
    """A content-addressed file: its name in the object that owns it, digest, size [bytes] and type."""

    name: str
    sha256: str
    size: int
    media_type: str = "application/octet-stream"


Item = TypeVar("Item")


class Page(Resource, Generic[Item]):
    """A page of a list, newest first; pass ``next_cursor`` as ``?cursor=`` for the next one."""

    data: list[Item]
    has_more: bool = False
    next_cursor: str | None = None


class FieldError(Resource):
    """One fault of the input: where (a path of keys) and what, with its numbers."""

    loc: list[str | int]
    msg: str


class Problem(Resource):
    """RFC 9457 problem details; ``code`` is stable, ``detail`` carries the numbers that broke."""

    type: str = "about:blank"
    title: str
    status: int
    code: str
    detail: str = ""
    request_id: str | None = None
    errors: list[FieldError] = Field(default_factory=list)
    hint: str | None = None


def holds_unstorable_characters(text: str) -> bool:
    """Whether Postgres would refuse the text."""
    if text.isascii():  # arrays in base64: the expression would take a second for what this finds at once
        return "\0" in text
    return _UNSTORABLE.search(text) is not None


def _holds_unstorable(value: Any) -> bool:
    waiting = [value]  # not by recursion: a body may be nested as deep as its reader allows
    while waiting:
        part = waiting.pop()
        if isinstance(part, str) and holds_unstorable_characters(part):
            return True
        if isinstance(part, dict):
            waiting += [*part.keys(), *part.values()]
        elif isinstance(part, list):
            waiting += [item for item in part if type(item) not in _PLAIN]
    return False


class Figures(Resource):
    """A free table of JSON figures (metrics, parameters) with the time at which it was made."""

    made_at: datetime | None = None
    values: dict[str, Any] = Field(default_factory=dict)
