"""Corrections of the generated OpenAPI document: problems as the one error schema, 429 wherever a key is asked for."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from physworld_schemas.base import Problem
from physworld_services.api.errors import documented

REFERENCE = "#/components/schemas/{model}"


def describe(app: FastAPI) -> None:
    """Make ``app.openapi`` add the problem schema that ``errors.documented`` refers to."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = generate()
            _, definitions = models_json_schema([(Problem, "serialization")], ref_template=REFERENCE)
            schemas = document.setdefault("components", {}).setdefault("schemas", {})
            for name, schema in definitions["$defs"].items():
                schemas.setdefault(name, schema)
            for methods in document["paths"].values():
                for operation in methods.values():
                    if operation.get("security"):
                        operation["responses"].setdefault("429", documented(429)[429])
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]
