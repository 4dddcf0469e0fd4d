"""The OpenAPI document shows of every property and parameter an example that its schema takes, and units of numbers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import jsonschema
import pytest

from physworld_services.api.example_values import BY_NAME, BY_PLACE
from physworld_services.api.examples import properties
from physworld_services.web import create_app
from physworld_storage.settings import Settings

MOST_BYTES = 330_000
LONGEST_EXAMPLE = 1500


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("data"))
    made: dict[str, Any] = create_app(settings).openapi()
    return json.loads(json.dumps(made))  # type: ignore[no-any-return]


def fields(document: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any], list[Any]]]:
    """(place, schema, examples) of every property and parameter; bytes of a file can have no example."""
    for owner, name, schema in properties(document):
        if schema.get("format") != "binary":
            yield f"{owner}.{name}", schema, schema.get("examples", [])
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            for one in operation.get("parameters", ()):
                examples = [one["example"]] if "example" in one else []
                yield f"{method} {path} {one['name']}", one["schema"], examples


def test_every_property_and_parameter_has_an_example(document: dict[str, Any]) -> None:
    found = list(fields(document))
    assert len(found) > 800
    assert [place for place, _, examples in found if not examples] == []


def test_every_example_is_what_its_schema_takes(document: dict[str, Any]) -> None:
    wrong = []
    for place, schema, examples in fields(document):
        rules = jsonschema.Draft202012Validator(
            {"components": document["components"], **schema},
            format_checker=jsonschema.Draft202012Validator.FORMAT_CHECKER,
        )
        wrong += [f"{place}: {fault.message}" for one in examples for fault in rules.iter_errors(one)]
        wrong += [f"{place}: null" for one in examples if one is None]
    assert wrong == []


def test_an_id_in_an_example_is_of_the_kind_that_its_field_names(document: dict[str, Any]) -> None:
    prefixes = {
        "scene_id": "scn_",
        "fit_id": "fit_",
        "dataset_id": "dst_",
        "trace_id": "trc_",
        "job_id": "job_",
    }
    for place, _, examples in fields(document):
        name = place.replace(" ", ".").rpartition(".")[2]
        assert all(one.startswith(prefixes[name]) for one in examples if name in prefixes), place


def test_every_number_has_a_unit(document: dict[str, Any]) -> None:
    def is_number(schema: dict[str, Any]) -> bool:
        return schema.get("type") == "number" or any(map(is_number, schema.get("anyOf", ())))

    numbers = [(owner, name, schema) for owner, name, schema in properties(document) if is_number(schema)]
    assert len(numbers) > 80
    assert [f"{owner}.{name}" for owner, name, schema in numbers if not schema.get("unit")] == []


def test_the_document_stays_small_enough_to_read(document: dict[str, Any]) -> None:
    assert len(json.dumps(document)) < MOST_BYTES
    lengths = {place: len(json.dumps(one)) for place, _, examples in fields(document) for one in examples}
    assert {place for place, length in lengths.items() if length > LONGEST_EXAMPLE} == set()


def test_values_of_examples_are_of_fields_that_there_are(document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]
    known = {f"{owner}.{name}" for owner, schema in schemas.items() for name in schema.get("properties", {})}
    assert {place for place in BY_PLACE if "." in place} - known == set()
    names = {name for _, name, _ in properties(document)}
    names |= {
        p["name"] for m in document["paths"].values() for o in m.values() for p in o.get("parameters", ())
    }
    assert {name for name in (*BY_NAME, *BY_PLACE) if "." not in name} - names == set()
