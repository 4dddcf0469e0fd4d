"""Bearer API keys and roles. Everything under ``/v1`` needs a key; a role includes those below it.

===== ============================================
read  GET and HEAD
write every other method
admin the keys themselves (``/v1/keys``, any method)
===== ============================================

The check runs before the body is read: a stranger cannot make the service receive an upload.
"""

from __future__ import annotations

from typing import Any

from fastapi import Security
from fastapi.security import HTTPBearer
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from schemas.key import Role
from services.api.errors import ApiProblem, answer
from storage import api_keys
from storage.api_keys import ApiKey as Principal
from storage.database import Database
from storage.errors import StorageError

_READING = frozenset({"GET", "HEAD", "OPTIONS"})
_CHALLENGE = {"WWW-Authenticate": 'Bearer realm="physworld"'}

# Documents the scheme; the middleware enforces it.
bearer: Any = Security(
    HTTPBearer(
        auto_error=False, scheme_name="ApiKey", description="An API key: `Authorization: Bearer <key>`"
    )
)


class Authentication:
    """ASGI middleware: puts the key behind the request into its state, or answers 401 or 403."""

    def __init__(self, app: ASGIApp, database: Database, prefix: str) -> None:
        self.app = app
        self.database = database
        self.prefix = prefix

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let the request through if its key has the role that method and path ask for."""
        if scope["type"] != "http" or not _is_below(scope["path"], self.prefix):
            await self.app(scope, receive, send)
            return
        try:
            principal = await run_in_threadpool(self._principal, Headers(scope=scope).get("Authorization"))
            _require(principal, required_role(scope["method"], scope["path"], self.prefix))
        except ApiProblem as problem:
            await answer(problem, scope)(scope, receive, send)
            return
        state = scope.setdefault("state", {})
        state["principal"] = principal
        state["key_id"] = principal.id
        await self.app(scope, receive, send)

    def _principal(self, header: str | None) -> Principal:
        scheme, _, token = (header or "").partition(" ")
        if scheme.lower() != "bearer" or not token:
            raise ApiProblem(
                401,
                "unauthenticated",
                "this address needs the header Authorization: Bearer <API key>",
                headers=_CHALLENGE,
            )
        try:
            with self.database.reading() as session:
                found = api_keys.verify(session, token.strip())
        except StorageError as error:
            raise ApiProblem(503, error.code, str(error), headers={"Retry-After": "2"}) from error
        if found is None:
            raise ApiProblem(
                401,
                "unauthenticated",
                "the API key is unknown or revoked",
                headers={"WWW-Authenticate": f'{_CHALLENGE["WWW-Authenticate"]}, error="invalid_token"'},
            )
        return found


def required_role(method: str, path: str, prefix: str) -> Role:
    """The role that a request needs."""
    if _is_below(path, f"{prefix}/keys"):
        return "admin"
    return "read" if method in _READING else "write"


def _require(principal: Principal, role: Role) -> None:
    if not principal.allows(role):
        raise ApiProblem(
            403,
            "forbidden",
            f"this needs the role {role}; the key {principal.id} has the role {principal.role}",
        )


def _is_below(path: str, prefix: str) -> bool:
    return path == prefix or path.startswith(f"{prefix}/")
