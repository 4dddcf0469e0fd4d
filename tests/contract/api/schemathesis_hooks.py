"""What no schema can say to a generator of requests, for ``st run`` with ``SCHEMATHESIS_HOOKS`` (CONTRIBUTING.md).

A cursor is what the page before gave out, an idempotency key is new for each request, an upload is a recording (any
other is refused with 422 as documented), a wait for a job's end is short, and what a path names is there: of most
requests that are meant to be right, the ids in the path are those of something that the service has, found by listing
the collection before them. What would delete or cancel it keeps made-up ids. The contract tests ask for these refusals
and for long waits themselves.
"""

from __future__ import annotations

import os
import random
import time
from uuid import uuid4

import httpx
import schemathesis
from schemathesis import Case, GenerationMode, HookContext

TOKEN = "PHYSWORLD_TOKEN"
"""Variable of the key; without it the ids stay made up."""
MOST_WAIT_S, LONGEST_WAIT_S = 1.0, 60.0
"""How long a request for a job waits here, lest queued jobs hold the run up, and how long it might."""
KNOWN_S = 20.0
"""How long a listing is remembered."""
SHARE = 0.8
"""Of the requests that are meant to be right, those that ask for what is there."""
_LISTED: dict[str, tuple[float, list[str]]] = {}
_RANDOM = random.Random(0)


@schemathesis.hook
def before_call(context: HookContext, case: Case, kwargs: dict[str, object]) -> None:
    """Wait shortly, and put real values in the place of generated ones in requests that are meant to be right."""
    if case.query and _number(case.query.get("wait")) <= LONGEST_WAIT_S:
        case.query["wait"] = min(_number(case.query["wait"]), MOST_WAIT_S)
    if case.meta is None or case.meta.generation.mode is not GenerationMode.POSITIVE:
        return
    if case.query:
        case.query.pop("cursor", None)
    if "Idempotency-Key" in (case.headers or {}):
        case.headers["Idempotency-Key"] = uuid4().hex
    ending = case.method.upper() == "DELETE" or case.path.endswith(("/cancel", "/rotate"))
    asked = bool(case.path_parameters) and TOKEN in os.environ
    if asked and not ending and _RANDOM.random() < SHARE:
        _name_what_is_there(case)


def _number(value: object) -> float:
    """A number of a query, or infinity."""
    try:
        return float(str(value))
    except ValueError:
        return float("inf")


def _name_what_is_there(case: Case) -> None:
    """Ids of the path from left to right, each out of the listing of what stands before it."""
    path = ""
    for part in case.path.strip("/").split("/"):
        if part.startswith("{"):
            parameter = part.strip("{}")
            known = _listed(case, path, "id" if parameter.endswith("_id") else parameter)
            if not known:
                return
            part = case.path_parameters[parameter] = _RANDOM.choice(known)
        path += f"/{part}"


def _listed(case: Case, path: str, key: str) -> list[str]:
    """How paths name what the collection at ``path`` has."""
    at, known = _LISTED.get(path, (0.0, []))
    if known and time.monotonic() - at < KNOWN_S:
        return known
    base = case.operation.schema.get_base_url().rstrip("/")
    headers = {"Authorization": f"Bearer {os.environ[TOKEN]}"}
    answer = httpx.get(f"{base}{path}", headers=headers, timeout=30.0)
    data = answer.json().get("data", []) if answer.status_code == 200 else []
    known = [str(item[key]) for item in data if key in item]
    _LISTED[path] = (time.monotonic(), known)
    return known
