"""Forms made from the wire models: a field's label, unit, bounds, default, help and choices are those of its schema.

``form_of`` describes the form of a request body, ``values_of`` reads what a browser sent for it. Names of inputs are
the places of fields in the body, ``config.episodes``, so that a fault of the body names its input. An input that is
left empty takes the field's default.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import BaseModel, ValidationError

from physworld.report import names
from physworld_services.dashboard.text import figure

InputKind = Literal["number", "switch", "choice", "choices", "weights", "text", "words"]
Options = Sequence[tuple[str, str]]
Schema = Mapping[str, Any]
MACHINES_LIMIT = 2**31 - 1
"""From here on a bound is what a database holds, and tells nobody what to choose."""


@dataclass(frozen=True)
class Input:
    """One field of a form; ``value`` is what stands in it, ``options`` what may be chosen."""

    name: str
    label: str
    kind: InputKind
    value: Any = None
    help: str = ""
    unit: str = ""
    bounds: str = ""
    least: float | None = None
    most: float | None = None
    step: str = "any"
    required: bool = False
    options: Options = ()
    fault: str = ""

    @property
    def key(self) -> str:
        """The input's id on the page."""
        return self.name.replace(".", "-") or "form"


@dataclass(frozen=True)
class Group:
    """The fields of one model; nested models are groups of their own."""

    name: str
    label: str
    help: str
    inputs: list[Input] = field(default_factory=list)
    groups: list[Group] = field(default_factory=list)

    @property
    def at_fault(self) -> bool:
        """Whether a field of the group, or of one inside it, has a fault: then it is shown open."""
        return any(item.fault for item in self.inputs) or any(group.at_fault for group in self.groups)


def form_of(
    model: type[BaseModel],
    values: Mapping[str, Any],
    choices: Mapping[str, Options],
    faults: Mapping[str, str] | None = None,
) -> Group:
    """The form of a body.

    Args:
        model: of the body.
        values: what stands in it at first, nested as the body is; what is missing takes its default.
        choices: what may be chosen for a field of the body's top, by its name: the objects that there are.
        faults: what is wrong, by the place of the field.
    """
    schema = model.model_json_schema()
    return _group(schema, schema, "", "", values, choices, faults or {})


def faults_of(error: ValidationError) -> dict[str, str]:
    """What is wrong by the place of the field; what concerns the whole body is under ``""``."""
    found: dict[str, str] = {}
    for fault in error.errors():
        place = ".".join(str(part) for part in fault["loc"] if isinstance(part, str))
        said = fault["msg"].removeprefix("Value error, ")
        found[place] = f"{found[place]}; {said}" if place in found else said
    return found


def values_of(model: type[BaseModel], sent: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """The body that a browser sent, as texts for the model to read; empty inputs are left out.

    Args:
        model: of the body.
        sent: the texts of every input, by its name.
    """
    schema = model.model_json_schema()
    return _read(schema, schema, "", sent)


def _group(
    schema: Schema,
    root: Schema,
    name: str,
    label: str,
    values: Mapping[str, Any],
    choices: Mapping[str, Options],
    faults: Mapping[str, str],
) -> Group:
    found = Group(name, label, str(schema.get("description", "")).partition("\n\n")[0])
    for key, raw in schema["properties"].items():
        place = f"{name}.{key}" if name else key
        described = _resolved(raw, root)
        nested = _object_of(described, root)
        given = values.get(key, described.get("default"))
        if nested is not None:
            inner = _group(nested, root, place, label_of(key), given or {}, {}, faults)
            found.groups.append(
                Group(place, inner.label, str(raw.get("description", "")), inner.inputs, inner.groups)
            )
        else:
            required = key in schema.get("required", ())
            made = _input(place, key, described, given, choices.get(key), required)
            if made is not None:
                faulty = [said for at, said in faults.items() if at == place or at.startswith(f"{place}.")]
                found.inputs.append(_with_fault(made, "; ".join(faulty)))
    return found


def _with_fault(made: Input, fault: str) -> Input:
    return made if not fault else Input(**{**vars(made), "fault": fault})


def _input(
    place: str, key: str, schema: Schema, value: Any, options: Options | None, required: bool
) -> Input | None:
    """The input of a field that is no model of its own; None for one that a form does not show."""
    own, optional = _without_null(schema)
    help_, unit = str(schema.get("description", "")), schema.get("unit", own.get("unit"))
    known: dict[str, Any] = {
        "name": place,
        "label": label_of(key),
        "help": help_,
        "unit": names.unit(key) if unit is None else names.written(str(unit)),
    }
    known |= {"value": value, "required": required and not optional}
    empty = [("", "usual" if value is None else "–")] if optional or not required else []
    if options is not None and own.get("type") == "array":
        return Input(
            kind="choices", options=options, **{**known, "value": [str(item) for item in value or ()]}
        )
    if options is not None:
        return Input(kind="choice", options=[*empty, *options], **{**known, "value": str(value or "")})
    if "enum" in own:
        listed = [(str(item), str(item).replace("_", " ")) for item in own["enum"]]
        return Input(kind="choice", options=[*(empty if optional else []), *listed], **known)
    if own.get("type") == "boolean":
        return Input(kind="switch", **known)
    if own.get("type") in {"number", "integer"}:
        return _number(own, known)
    if own.get("type") == "array" and "enum" in own.get("items", {}):
        listed = [(str(item), str(item).replace("_", " ")) for item in own["items"]["enum"]]
        return Input(kind="choices", options=listed, **known)
    if own.get("type") == "array" and own.get("items", {}).get("type") in {"string", "integer"}:
        return Input(kind="words", **{**known, "value": ", ".join(map(str, value or ()))})
    if own.get("type") == "object" and "enum" in own.get("propertyNames", {}):
        listed = [(str(item), str(item).replace("_", " ")) for item in own["propertyNames"]["enum"]]
        return Input(kind="weights", options=listed, least=0.0, **{**known, "value": value or {}})
    if own.get("type") == "string" and "const" not in own:
        return Input(kind="text", **{**known, "value": "" if value is None else str(value)})
    return None


def _number(schema: Schema, known: dict[str, Any]) -> Input:
    least = schema.get("minimum", schema.get("exclusiveMinimum"))
    most = schema.get("maximum", schema.get("exclusiveMaximum"))
    low = None if least is None else figure(float(least))
    high = None if most is None or most >= MACHINES_LIMIT else figure(float(most))
    bounds = f"{low} to {high}" if low and high else f"from {low}" if low else f"to {high}" if high else ""
    if "exclusiveMinimum" in schema:
        bounds = f"above {low}" + (f", to {high}" if high else "")
    step = "1" if schema["type"] == "integer" else "any"
    return Input(kind="number", bounds=bounds, least=least, most=most, step=step, **known)


def _read(schema: Schema, root: Schema, name: str, sent: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    body: dict[str, Any] = {}
    for key, raw in schema["properties"].items():
        place = f"{name}.{key}" if name else key
        described = _resolved(raw, root)
        nested = _object_of(described, root)
        if nested is not None:
            body[key] = _read(nested, root, place, sent)
            continue
        own, optional = _without_null(described)
        texts = [text.strip() for text in sent.get(place, ())]
        if own.get("type") == "boolean":
            body[key] = bool(texts)
        elif own.get("type") == "array":
            listed = texts if len(texts) != 1 else [part.strip() for part in texts[0].split(",")]
            if any(listed) or not optional:
                body[key] = [text for text in listed if text]
        elif own.get("type") == "object":
            weights = {
                text: sent[f"{place}.{text}"][0].strip()
                for text in own.get("propertyNames", {}).get("enum", ())
                if sent.get(f"{place}.{text}", [""])[0].strip()
            }
            if weights:
                body[key] = weights
        elif texts and texts[0]:
            body[key] = texts[0]
    return body


def _resolved(schema: Schema, root: Schema) -> Schema:
    """A field's schema with what it refers to; its own description stands."""
    reference = schema.get("$ref")
    if reference is None:
        return schema
    target = root["$defs"][str(reference).rpartition("/")[2]]
    return {**target, **{key: value for key, value in schema.items() if key != "$ref"}}


def _object_of(schema: Schema, root: Schema) -> Schema | None:
    """The schema of a model of its own, which is a group of the form; None for any other field."""
    return schema if schema.get("type") == "object" and "properties" in schema else None


def _without_null(schema: Schema) -> tuple[Schema, bool]:
    """A field's schema without the null that it may be, and whether it may be."""
    parts = schema.get("anyOf")
    if parts is None:
        return schema, False
    own = [part for part in parts if part.get("type") != "null"]
    text = [part for part in own if part.get("type") == "string"]  # a text may be a number as well
    return (*text, *own, schema)[0], len(own) < len(parts)


def label_of(key: str) -> str:
    """``time_limit_s`` as ``Time limit``, ``scene_id`` as ``Scene``."""
    return names.sentence(names.label(key))
