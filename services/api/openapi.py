"""What the generated OpenAPI document lacks: an introduction, words for parameters and pages, problems, examples."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from pydantic.json_schema import models_json_schema

from physworld_schemas.base import Page, Problem
from physworld_schemas.job import Event
from physworld_services.api.errors import documented
from physworld_services.api.examples import illustrate

INTRODUCTION = """
Send a recording (`POST /v1/scenes`), start the whole chain (`POST /v1/pipelines`), follow its job
(`GET /v1/jobs/{job_id}?wait=30`), use the model (`POST /v1/rollouts`).

**Keys.** Every request below `/v1` carries `Authorization: Bearer <API key>`. Roles: `read` looks, `write` also
starts and deletes work, `admin` also manages keys.

**Work** is asynchronous: a POST that starts some answers 202 with a job, whose `outputs` name what it makes. A POST
with an `Idempotency-Key` can be sent again without starting work twice.

**Lists** are pages, newest first. `cursor` is opaque: pass `next_cursor` on as it is; another text is refused with
422.

**Problems** are RFC 9457 documents: `code` is stable, `detail` has the numbers that broke, `errors` the place of each
fault.

**Numbers** are in SI units; a field's `unit` says which (`1`: none), names end in it (`track_m`). Identifiers are a
prefix and 26 characters that sort by time. Seeds are whole numbers from 0 to 2⁶³ − 1.
""".strip()
PARAMETERS = {
    "state": "Only those in this state.",
    "kind": "Only those of this kind.",
    "scene_id": "Only those of this scene.",
    "fit_id": "Only those of this fit.",
    "verdict": "Only those with this verdict.",
    "model": "Only those of the model of this name.",
    "name": "Name of the model.",
    "alias": "Name that points at a version: lower case, digits, _ -; not `latest`, not a number.",
    "if-none-match": "Digests that are there already: 304 where the artifact is one of them.",
    "if-range": "The range counts only if the artifact still has this digest.",
    "Range": "Part of the bytes, `bytes=first-last`: 206 with the part, 416 where there is none.",
}
"""Of parameters that mean the same wherever they stand."""
REFERENCE = "#/components/schemas/{model}"


def describe(app: FastAPI) -> None:
    """Make ``app.openapi`` add what no model of a route names, and the words that are missing."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = generate()
            _, definitions = models_json_schema(
                [(Problem, "serialization"), (Event, "serialization")], ref_template=REFERENCE
            )
            schemas = document.setdefault("components", {}).setdefault("schemas", {})
            for name, schema in definitions["$defs"].items():
                schemas.setdefault(name, schema)
            document["info"]["description"] = INTRODUCTION
            for name, schema in schemas.items():
                if name.startswith("Page_"):
                    schema.setdefault("description", Page.__doc__)
            for methods in document["paths"].values():
                for operation in methods.values():
                    for parameter in operation.get("parameters", ()):
                        parameter["schema"] = _without_null(parameter["schema"])
                        if parameter["name"] in PARAMETERS:
                            parameter.setdefault("description", PARAMETERS[parameter["name"]])
                    if operation.get("security"):
                        operation["responses"].setdefault("429", documented(429)[429])
            illustrate(document)
            app.openapi_schema = document
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _without_null(schema: dict[str, Any]) -> dict[str, Any]:
    """A parameter's schema without null: one that is not meant is left out, `null` would be a text."""
    kinds = [kind for kind in schema.get("anyOf", ()) if kind != {"type": "null"}]
    if len(kinds) != 1:
        return schema
    return {**kinds[0], **{key: value for key, value in schema.items() if key != "anyOf"}}
