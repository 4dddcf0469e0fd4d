"""RFC 9457 problem details: every answer that is not a success is one ``application/problem+json``.

``code`` is stable and is what a client branches on; ``detail`` carries the numbers that broke; ``errors``
names each field at fault; ``request_id`` finds the line in the access log. The framework's own answers (no
such path, wrong method, body that does not validate) and the storage's exceptions are translated here, once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import DataError
from starlette.exceptions import HTTPException
from starlette.routing import compile_path

from physworld_scenes.errors import SceneInvalid
from physworld_schemas.base import FieldError, Problem
from physworld_schemas.hints import hint_of
from physworld_storage.errors import (
    ArtifactCorrupt,
    Conflict,
    DatabaseUnavailable,
    EpisodeCorrupt,
    IdempotencyMismatch,
    InvalidCursor,
    NotFound,
    StorageError,
    StoreError,
    StoreFull,
)

PROBLEM_MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:physworld:problem:"

UNREAD = "There was an error parsing the body"
"""What the framework says, with 400, of a body that is no JSON in UTF-8."""
_CODES = {
    400: "bad_request",
    401: "unauthenticated",
    403: "forbidden",
    404: "not_found",
    405: "method_not_allowed",
    406: "not_acceptable",
    409: "conflict",
    413: "content_too_large",
    415: "unsupported_media_type",
    416: "range_not_satisfiable",
    422: "invalid_request",
    429: "too_many_requests",
    500: "internal_error",
    503: "unavailable",
}

# Which status an error of the storage answers with; the first class that fits, so children before parents.
_STORAGE_STATUS: tuple[tuple[type[StorageError], int], ...] = (
    (NotFound, 404),
    (IdempotencyMismatch, 422),
    (Conflict, 409),
    (InvalidCursor, 422),
    (DatabaseUnavailable, 503),
    (ArtifactCorrupt, 500),
    (EpisodeCorrupt, 500),
    (StoreFull, 507),
    (StoreError, 503),
)

log = structlog.get_logger("physworld.api")


class ApiProblem(HTTPException):
    """A problem that a route or a middleware answers with; raised, never returned.

    Args:
        status: of HTTP.
        code: stable name of the problem, the end of its type.
        detail: what went wrong, with the numbers.
        errors: faults of single fields.
        hint: what to do about it; None takes the code's own.
        headers: of the answer, such as Retry-After.
    """

    def __init__(
        self,
        status: int,
        code: str,
        detail: str,
        *,
        errors: Sequence[FieldError] = (),
        hint: str | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(status_code=status, detail=detail, headers=headers)
        self.code = code
        self.errors = list(errors)
        self.hint = hint


def problem_response(
    status: int,
    code: str,
    detail: str,
    *,
    request_id: str | None,
    errors: Sequence[FieldError] = (),
    hint: str | None = None,
    headers: Mapping[str, str] | None = None,
    **more: Any,
) -> JSONResponse:
    """The answer for one problem.

    Args:
        status: of HTTP.
        code: stable name of the problem, the end of its type.
        detail: what went wrong, with the numbers; characters that are not printable are replaced.
        request_id: of the request, also in the log.
        errors: faults of single fields.
        hint: what to do about it; None takes the code's own.
        headers: of the answer, such as Retry-After.
        **more: members of the problem that only this kind has.
    """
    problem = Problem(
        type=f"{TYPE_PREFIX}{code}",
        title=HTTPStatus(status).phrase,
        status=status,
        code=code,
        detail=_printable(detail),
        request_id=request_id,
        errors=[_printable_fault(fault) for fault in errors],
        hint=hint or hint_of(code),
    )
    return JSONResponse(
        {**problem.model_dump(mode="json", exclude={"hint"} if problem.hint is None else None), **more},
        status,
        headers=dict(headers or {}),
        media_type=PROBLEM_MEDIA_TYPE,
    )


def _printable(text: str) -> str:
    """The text with halves of surrogate pairs written out: UTF-8 has none, and what a client sent may hold them."""
    return text.encode("utf-8", "backslashreplace").decode()


def _printable_fault(fault: FieldError) -> FieldError:
    loc = [_printable(part) if isinstance(part, str) else part for part in fault.loc]
    return FieldError(loc=loc, msg=_printable(fault.msg))


def answer(problem: ApiProblem, scope: Mapping[str, Any]) -> JSONResponse:
    """The answer for a raised problem, in the request of this ASGI scope."""
    return problem_response(
        problem.status_code,
        problem.code,
        problem.detail,
        request_id=request_id_of(scope),
        errors=problem.errors,
        hint=problem.hint,
        headers=problem.headers,
    )


def request_id_of(scope: Mapping[str, Any]) -> str | None:
    """The id that the access log gave this request (``physworld_services.api.access``)."""
    found: str | None = scope.get("state", {}).get("request_id")
    return found


def documented(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The ``responses=`` of a route: which problems it answers with, for the OpenAPI document."""
    return {
        status: {
            "description": HTTPStatus(status).phrase,
            "content": {PROBLEM_MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
        }
        for status in statuses
    }


def install(app: FastAPI) -> None:
    """Register the translation of every exception that leaves a route."""
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(DataError, _unstorable)
    app.add_exception_handler(StorageError, _storage)
    app.add_exception_handler(SceneInvalid, _scene)
    app.add_exception_handler(Exception, _unexpected)


async def _http(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    if isinstance(error, ApiProblem):
        return answer(error, request.scope)
    status, headers = error.status_code, error.headers
    detail = str(error.detail)
    if detail == UNREAD:
        status, detail = 422, "the body is no JSON in UTF-8, or not of the form that this address takes"
    if status == 405:
        headers = {"Allow": ", ".join(sorted(_methods_at(request))) or (headers or {}).get("Allow", "")}
    if detail == HTTPStatus(status).phrase:
        detail = f"{detail}: {request.method} {request.url.path}"
    return problem_response(
        status,
        _CODES.get(status, "error"),
        detail,
        request_id=request_id_of(request.scope),
        headers=headers,
    )


def _methods_at(request: Request) -> set[str]:
    """All methods that the document has for this address: the framework's answer names those of one route alone."""
    paths: dict[str, dict[str, object]] = request.app.openapi()["paths"]
    here = [path for path in paths if compile_path(path)[0].match(request.url.path)]
    nearest = min(
        here, key=lambda path: path.count("{"), default=None
    )  # /scenes/preview is no /scenes/{scene_id}
    return set() if nearest is None else {method.upper() for method in paths[nearest]}


async def _invalid(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    faults = [FieldError(loc=list(fault["loc"]), msg=fault["msg"]) for fault in error.errors()]
    detail = "; ".join(f"{'.'.join(map(str, fault.loc))}: {fault.msg}" for fault in faults[:3])
    if len(faults) > 3:
        detail += f"; and {len(faults) - 3} more"
    return problem_response(
        422, "invalid_request", detail, request_id=request_id_of(request.scope), errors=faults
    )


async def _unstorable(request: Request, error: Exception) -> JSONResponse:
    """A value that the schema allows and the database refuses, e.g. a NUL character in Postgres text."""
    assert isinstance(error, DataError)
    return problem_response(
        422,
        "invalid_request",
        f"the database refuses a value of this request: {error.orig}",
        request_id=request_id_of(request.scope),
    )


async def _storage(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, StorageError)
    status = next((status for kind, status in _STORAGE_STATUS if isinstance(error, kind)), 500)
    if status >= 500:
        log.error(error.code, path=request.url.path, error=str(error))
    return problem_response(
        status,
        "idempotency_key_reused" if isinstance(error, IdempotencyMismatch) else error.code,
        error.told,
        request_id=request_id_of(request.scope),
        headers={"Retry-After": "2"} if status == 503 else None,
    )


async def _scene(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, SceneInvalid)
    return problem_response(
        422, error.code, str(error), request_id=request_id_of(request.scope), errors=error.faults
    )


async def _unexpected(request: Request, error: Exception) -> JSONResponse:
    """A fault of ours. The text of the exception stays in the log: it may hold addresses or secrets."""
    request_id = request_id_of(request.scope)
    return problem_response(
        500,
        "internal_error",
        f"an unexpected fault while answering {request.method} {request.url.path}",
        request_id=request_id,
        headers={"X-Request-Id": request_id} if request_id else None,
    )
