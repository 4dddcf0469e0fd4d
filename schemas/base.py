"""Base classes of the wire models: strict about unknown fields on input, tolerant on output."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from datetime import datetime
from html import escape
from typing import Annotated, Any, Generic, Literal, Self, TypeVar, get_args, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from physworld_schemas.arrays import single_values
from physworld_schemas.wording import meant

ObjectKind = Literal[
    "scene", "check", "fit", "trace", "dataset", "model", "assessment", "rollout", "plan", "video", "artifact"
]
Tag = Annotated[str, Field(min_length=1, max_length=64)]
"""A word or a few by which people find an object again."""
Unmade = Literal["failed", "cancelled"]
"""States of an object that its job did not make."""
_UNSTORABLE = re.compile("[\0\ud800-\udfff]")
STORABLE_TEXT = r"^[^\x00]*$"
LINE, LONGEST_TEXT = 120, 40
"""Characters of the line that an object is shown in, and of a text in it."""
_LITERAL = "{said}"
_SINGLE = frozenset({float, int, bool})
_PLAIN = _SINGLE | {type(None)}
TEXTS = {"texts": True}
"""Context of a validation that reads numbers, true and false from texts, as a form of a browser sends them."""
RATIO: dict[str, Any] = {"unit": "1"}
UNIT_BESIDE: dict[str, Any] = {"unit": "that of the field `unit`"}
UNIT_OF_METRIC: dict[str, Any] = {"unit": "that of the metric"}
"""What the schema of a number says of its unit: it has none, or it depends on what is measured."""
Seed = Annotated[int, Field(ge=0, lt=2**63, json_schema_extra={"format": "int64"})]


def _told_storable(schema: dict[str, Any]) -> None:
    """Say of every plain text in the schema of a request that it holds no NUL, which ``_storable`` refuses."""
    for part in schema.get("properties", {}).values():
        _tell_storable(part)


def _tell_storable(part: dict[str, Any]) -> None:
    if part.get("type") == "string" and not part.keys() & {"pattern", "enum", "const", "format"}:
        part["pattern"] = STORABLE_TEXT
    for inner in (*part.get("anyOf", ()), part.get("items")):
        if isinstance(inner, dict):
            _tell_storable(inner)


class Request(BaseModel):
    """A body that a client sends: an unknown field is an error, not a silent typo."""

    model_config = ConfigDict(extra="forbid", json_schema_extra=_told_storable)

    @model_validator(mode="before")
    @classmethod
    def _storable(cls, value: Any) -> Any:
        """Refuse text that Postgres keeps neither as text nor in JSON: NUL, and halves of surrogate pairs."""
        if _holds_unstorable(value):
            raise ValueError("holds a NUL character or half of a surrogate pair")
        return value

    @model_validator(mode="wrap")
    @classmethod
    def _every_fault(cls, value: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo) -> Self:
        """Say of an unknown key which one was probably meant, and refuse values of another kind."""
        try:
            made, faults = handler(value), []
        except ValidationError as error:
            made, faults = None, [_told(fault, cls.model_fields) for fault in error.errors(include_url=False)]
        if isinstance(value, dict):
            known = {fault["loc"][0] for fault in faults if fault["loc"]}
            faults += _confused({name: value[name] for name in value.keys() - known}, cls, bool(info.context))
        if made is None or faults:
            raise ValidationError.from_exception_data(cls.__name__, faults)
        return made


class _More:
    """Shown at the end of a line that has no room for all fields."""

    def __repr__(self) -> str:
        return "…"


class Resource(BaseModel):
    """An object that the service returns: a newer service may add fields."""

    model_config = ConfigDict(extra="ignore")

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """What a line has room for: plain fields that are set, long texts cut, the rest as an ellipsis."""
        left = LINE
        for name, value in self._plain_fields():
            shown = value if len(str(value)) <= LONGEST_TEXT else f"{str(value)[: LONGEST_TEXT - 1]}…"
            left -= len(f"{name}={shown!r}, ")
            if left < 0:
                yield None, _More()
                return
            yield name, shown

    def _repr_html_(self) -> str:
        """The plain fields as a table, for notebooks."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(name)}</th><td>{escape(str(value))}</td></tr>"
            for name, value in self._plain_fields()
        )
        return f"<table><caption>{escape(type(self).__name__)}</caption><tbody>{rows}</tbody></table>"

    def _plain_fields(self) -> Iterator[tuple[str, Any]]:
        for name in type(self).model_fields:
            value = getattr(self, name)
            if value not in (None, "") and isinstance(value, str | int | float | bool | datetime):
                yield name, value


class Reference(Resource):
    """One input of an object: what it was made from, and the digest it had then."""

    kind: ObjectKind = Field(description="What is referred to.")
    id: str = Field(description="Its identifier; of a model `name:version`.")
    digest: str | None = Field(default=None, description="Its SHA-256 at that time; null: it had none.")


class Lineage(Resource):
    """What made an object; the same inputs, code and configuration make it again."""

    inputs: list[Reference] = Field(default_factory=list, description="What it was made from.")
    code_version: str = Field(default="", description="Version of PhysWorld.")
    config_digest: str = Field(default="", description="SHA-256 of the settings.")
    seeds: dict[str, int] = Field(default_factory=dict, description="Seeds by stage.")
    device: str = Field(default="", description="Device that computed it.", examples=["cpu"])
    job_id: str | None = Field(default=None, description="Job that made it.")


class Artifact(Resource):
    """A content-addressed file: its name in the object that owns it, digest, size [bytes] and type."""

    name: str = Field(description="File name within its object.", examples=["report.json"])
    sha256: str = Field(description="SHA-256 of the bytes: the address of the file.")
    size: int = Field(description="Size.", json_schema_extra={"unit": "B"})
    media_type: str = Field(default="application/octet-stream", description="Media type.")


Item = TypeVar("Item")


class Page(Resource, Generic[Item]):
    """A page of a list, newest first; pass ``next_cursor`` as ``?cursor=`` for the next one."""

    data: list[Item] = Field(description="Items of this page.")
    has_more: bool = Field(default=False, description="Whether another page follows.")
    next_cursor: str | None = Field(
        default=None, description="Opaque: pass it on as `cursor` for the next page; null on the last."
    )


class FieldError(Resource):
    """One fault of the input: where (a path of keys) and what, with its numbers."""

    loc: list[str | int] = Field(
        description="Path of keys to the fault.", examples=[["body", "config", "episodes"]]
    )
    msg: str = Field(description="What is wrong, with its numbers.")


class Problem(Resource):
    """RFC 9457 problem details; ``code`` is stable, ``detail`` carries the numbers that broke."""

    type: str = Field(default="about:blank", description="URN of the kind of problem.")
    title: str = Field(description="Kind of problem, for people.")
    status: int = Field(description="HTTP status.", examples=[422])
    code: str = Field(description="Stable code to branch on.", examples=["invalid_request"])
    detail: str = Field(default="", description="What went wrong, with its numbers.")
    request_id: str | None = Field(default=None, description="Finds the request in the service's log.")
    errors: list[FieldError] = Field(default_factory=list, description="Each fault with its place.")
    hint: str | None = Field(default=None, description="What to do about it; absent: nothing is known.")


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


def _confused(body: dict[str, Any], model: type[BaseModel], texts: bool) -> list[InitErrorDetails]:
    """Values that Pydantic would turn into the numbers, or into the true and false, that their fields ask for."""
    found = []
    for name, field in model.model_fields.items():
        said = _mistaken(set(_kinds(field.annotation)), body.get(name), texts)
        if said:
            text = PydanticCustomError("another_kind", _LITERAL, {"said": said})
            found.append(InitErrorDetails(type=text, loc=(name,), input=body[name]))
    return found


def _mistaken(kinds: set[Any], given: Any, texts: bool) -> str:
    """How one of the given values is of another kind than those; empty: none is."""
    wanted = kinds & _SINGLE
    for item in single_values(given) if wanted else ():
        if isinstance(item, bool) and bool not in wanted:
            return "true and false are no numbers"
        if isinstance(item, int | float) and not isinstance(item, bool) and wanted == {bool}:
            return f"{item} is neither true nor false"
        if isinstance(item, str) and kinds <= _PLAIN and not texts:
            return "a text where " + ("true or false" if wanted == {bool} else "a number") + " is asked for"
    return ""


def _kinds(annotation: Any) -> Iterator[Any]:
    """The types of the single values of a field, whatever they are listed in."""
    parts, origin = get_args(annotation), get_origin(annotation)
    if not parts or origin is Literal:
        yield annotation
    elif origin is Annotated:
        yield from _kinds(parts[0])
    else:
        for part in parts[1:] if origin is dict else parts:
            yield from _kinds(part)


def _told(fault: ErrorDetails, known: Iterable[str]) -> InitErrorDetails:
    """A fault as it was, an unknown key of this very model with the nearest known one."""
    place, kind = fault["loc"], fault["type"]
    said = meant(str(place[0]), known) if kind == "extra_forbidden" and len(place) == 1 else fault["msg"]
    text = PydanticCustomError(kind, _LITERAL, {"said": said})
    return InitErrorDetails(type=text, loc=place, input=fault["input"])
