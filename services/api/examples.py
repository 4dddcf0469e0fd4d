"""Examples of the OpenAPI document: one for every property of a schema and for every parameter.

A field of ``schemas/`` that names its own example keeps it. Any other one has what ``example_values.py`` says of it,
else an id, its first choice or its default; an object is made of the examples of the properties that it must have, or,
where it needs none, of the first two that are plain.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from physworld_schemas.ids import PREFIXES
from physworld_services.api.example_values import BY_NAME, BY_PLACE, ULID

Schema = dict[str, Any]
KINDS_OF_IDS = {"ApiKey": "key", "Loop": "job", "VideoCreate": "fit", "loop": "job", "parent": "job"} | {
    "comparison": "assessment"
}
"""Whose ids are those of another kind than their name says."""
DONE = ("ready", "sealed", "succeeded")
"""States of an example, where it has one of them."""
PLAIN = str | int | float | bool
SHORT = 2
NUMBER = "youngs_modulus_pa"
"""The key of an object whose keys are free: they name numbers."""


def illustrate(document: Schema) -> None:
    """Give every property and parameter of a document that has no example one; bytes of a file have none."""
    made = Examples(document["components"]["schemas"])
    for owner, name, schema in properties(document):
        if schema.get("format") != "binary" and "examples" not in schema:
            example = made.of(owner, name, schema)
            if example is not None:
                schema["examples"] = [example]
    for methods in document["paths"].values():
        for operation in methods.values():
            for parameter in operation.get("parameters", ()):
                example = made.of("", parameter["name"], parameter["schema"])
                if example is not None:
                    parameter.setdefault("example", example)


def properties(part: Any, owner: str = "") -> Iterator[tuple[str, str, Schema]]:
    """(name of the schema that it is of, name, schema) of every property in a part of a document."""
    if isinstance(part, list):
        for item in part:
            yield from properties(item, owner)
    if not isinstance(part, dict):
        return
    for key, item in part.items():
        if key in ("examples", "default", "enum"):
            continue
        if key == "schemas" and isinstance(item, dict):
            for name, schema in item.items():
                yield from properties(schema, name)
            continue
        yield from properties(item, owner)
        if key == "properties" and all(isinstance(schema, dict) for schema in item.values()):
            yield from ((owner, name, schema) for name, schema in item.items())


class Examples:
    """Makes examples.

    Args:
        schemas: of the document, by their names.
    """

    def __init__(self, schemas: Schema) -> None:
        self._schemas = schemas

    def of(self, owner: str, name: str, schema: Schema) -> Any:
        """The example of a field; None where nothing is known of it.

        Args:
            owner: the schema whose property it is; empty for a parameter.
            name: of the property or parameter.
            schema: of its values.
        """
        if schema.get("examples"):
            return schema["examples"][0]
        alternatives: list[Schema] = schema.get("anyOf") or schema.get("oneOf") or [schema]
        kinds = [kind for kind in alternatives if kind != {"type": "null"}]
        choices = [choice for kind in kinds for choice in _choices(kind)]
        place = f"{owner}.{name}" if owner else name
        if place in BY_PLACE:
            return BY_PLACE[place]
        if choices:
            return schema.get("default") or next((one for one in DONE if one in choices), choices[0])
        if name.endswith("id") and (found := _id(owner, name)):
            return found
        if name in BY_NAME and not any("$ref" in kind for kind in kinds):
            return BY_NAME[name]
        if isinstance(schema.get("default"), PLAIN) and schema["default"] != "":
            return schema["default"]
        return self._made(kinds[0])

    def _made(self, kind: Schema) -> Any:
        """The example of a structure: of what it refers to, of a list with one item, of an object with one key."""
        if "$ref" in kind:
            return self._object(kind["$ref"].rpartition("/")[2])
        if kind.get("type") == "array":
            item = self.of("", "", kind.get("items", {}))
            return None if item is None else [item]
        inner = kind.get("additionalProperties")
        if kind.get("type") == "object" and isinstance(inner, dict):
            value = self.of("", "", inner)
            return None if value is None else {NUMBER: value}
        return None

    def _object(self, name: str) -> Any:
        """An object of a schema, no larger than it must be."""
        schema = self._schemas[name]
        fields: Schema = schema.get("properties", {})
        if wanted := schema.get("required", []):
            return {field: self.of(name, field, fields[field]) for field in wanted}
        made = {field: self.of(name, field, inner) for field, inner in fields.items()}
        plain = [field for field, example in made.items() if isinstance(example, PLAIN)]
        return {field: made[field] for field in (plain or list(made))[:SHORT]}


def _choices(kind: Schema) -> list[Any]:
    """The values that a schema lists."""
    return [*kind.get("enum", ()), *([kind["const"]] if "const" in kind else [])]


def _id(owner: str, name: str) -> str | None:
    """An id of the kind that a field names: ``scene_id``, or ``id`` of a Scene."""
    what = owner if name == "id" else name.removesuffix("_id")
    kind = KINDS_OF_IDS.get(what, what.lower())
    return f"{PREFIXES[kind]}_{ULID}" if kind in PREFIXES else None
