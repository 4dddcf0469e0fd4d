"""What no schema can say to a generator of requests, for ``st run`` with ``SCHEMATHESIS_HOOKS`` (CONTRIBUTING.md).

A cursor is what the page before gave out, an idempotency key is new for each request, an upload is a recording (any
other is refused with 422 as documented), a wait for a job's end is short, and what a path or a body names is there: of
most requests that are meant to be right, the ids are those of something that the service has, found by listing the
collection before them. What a request deletes, cancels, retries or rotates is made for it (``schemathesis_real``). The
contract tests ask for the refusals and for long waits themselves.
"""

from __future__ import annotations

import atexit
import io
import os
import random
import zipfile
from typing import Any
from uuid import uuid4

import schemathesis
from schemathesis import Case, GenerationMode, HookContext
from schemathesis_real import Answers, Real


def pictures() -> bytes:
    """A zip that begins as a folder of pictures with depth does."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in ("color/0.png", "color/1.png", "depth/0.png", "depth/1.png"):
            archive.writestr(name, b"\x89PNG\r\n\x1a\n")
    return buffer.getvalue()


TOKEN = "PHYSWORLD_TOKEN"
"""Variable of the key; without it the ids stay made up."""
MOST_WAIT_S, LONGEST_WAIT_S = 1.0, 60.0
"""How long a request for a job waits here, lest queued jobs hold the run up, and how long it might."""
SHARE = 0.8
"""Of the requests that are meant to be right, those that ask for what is there."""
WHOLE = {"/v1/rollouts": Real.rollout, "/v1/plans": Real.plan, "/v1/loops": Real.loop}
"""Bodies that have to fit a model: half of the requests take these."""
FULL = (("/tracks", "/v1/traces", "?state=ready"), ("/episodes/", "/v1/datasets", "?state=sealed"))
"""Parts of paths that only such items of a listing have."""
PICTURES = pictures()
_SERVICES: dict[str, Real] = {}
_RANDOM = random.Random(0)
_ANSWERS = Answers()
atexit.register(_ANSWERS.write)


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
    if TOKEN not in os.environ or _RANDOM.random() >= SHARE:
        return
    real = _service(case)
    if isinstance(case.body, dict):
        case.body = _body(case, real)
    ending = real.ends.get((case.method.upper(), case.path))
    if ending is not None:
        case.path_parameters.update(ending() or {})
    elif case.path == "/v1/loops/{loop_id}":
        case.path_parameters["loop_id"] = real.looped()
    elif case.path.endswith("/compare"):
        case.path_parameters["name"], case.query = real.compared()
    elif case.path_parameters and case.method.upper() != "DELETE":
        _name_what_is_there(case, real)
    if case.path.endswith("/aliases/{alias}") and case.method.upper() == "PUT":
        case.body = {"version": real.latest(case.path_parameters["name"])}


@schemathesis.hook
def after_call(context: HookContext, case: Case, response: Any) -> None:
    """Keep which operations ever succeeded."""
    _ANSWERS.add(f"{case.method.upper()} {case.path}", response.status_code)


def _service(case: Case) -> Real:
    base = case.operation.schema.get_base_url().rstrip("/")
    if base not in _SERVICES:
        _SERVICES[base] = Real(base, os.environ[TOKEN])
    return _SERVICES[base]


def _body(case: Case, real: Real) -> dict[str, Any]:
    """The body with real names in it."""
    if case.path in WHOLE and _RANDOM.random() < 0.5:
        return WHOLE[case.path](real)
    if case.path in ("/v1/scenes", "/v1/scenes/preview"):
        return {"bundle": real.archive()}
    if case.path in ("/v1/trackings", "/v1/trackings/preview"):
        return {"bundle": PICTURES}
    if case.path.endswith("/pictures/{name}"):
        case.path_parameters["name"] = "splat.ply"
        return {"bundle": b"ply\nformat binary_little_endian 1.0\nend_header\n"}
    if case.path == "/v1/videos":
        return {**case.body, "of": "scene", "id": real.one("/v1/scenes")}
    return real.named(case.body)


def _number(value: object) -> float:
    """A number of a query, or infinity."""
    try:
        return float(str(value))
    except ValueError:
        return float("inf")


def _name_what_is_there(case: Case, real: Real) -> None:
    """Ids of the path from left to right, each out of the listing of what stands before it."""
    path = ""
    for part in case.path.strip("/").split("/"):
        if part.startswith("{"):
            parameter = part.strip("{}")
            if parameter == "sha256":
                case.path_parameters[parameter] = real.digest()
                return
            if parameter in case.path_parameters and path.endswith("/pictures"):
                return
            state = next((state for part, of, state in FULL if part in case.path and path == of), "")
            known = real.listed(path + state, "id" if parameter.endswith("_id") else parameter)
            if not known:
                return
            part = case.path_parameters[parameter] = _RANDOM.choice(known)
        path += f"/{part}"
