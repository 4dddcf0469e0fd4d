"""Bearer API keys and roles. Everything under ``/v1`` needs a key; a role includes those below it.

===== ============================================
read  GET and HEAD
write every other method
admin keys and audit log (``/v1/keys``, ``/v1/audit``)
===== ============================================

The check runs before the body is read: a stranger cannot make the service receive an upload.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import structlog
from fastapi import Security
from fastapi.security import HTTPBearer
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from physworld_schemas.key import Role
from physworld_services.api.attempts import PER_ADDRESS, WINDOW_S, Attempts
from physworld_services.api.errors import ApiProblem, answer
from physworld_storage.access import api_keys, audit
from physworld_storage.access.api_keys import ApiKey as Principal
from physworld_storage.access.audit import Actor
from physworld_storage.database import Database
from physworld_storage.errors import StorageError

_READING = frozenset({"GET", "HEAD", "OPTIONS"})
_CHALLENGE = {"WWW-Authenticate": 'Bearer realm="physworld"'}

log = structlog.get_logger("physworld.api")

# Documents the scheme; the middleware enforces it.
bearer: Any = Security(
    HTTPBearer(
        auto_error=False, scheme_name="ApiKey", description="An API key: `Authorization: Bearer <key>`"
    )
)


class Gate:
    """Lets in who has a key: looks the token up, and counts those that are none."""

    def __init__(self, database: Database, attempts: Attempts) -> None:
        self._database = database
        self._attempts = attempts

    def key_of(self, token: str, address: str | None) -> Principal | None:
        """The key behind a token, None when there is none.

        Raises ApiProblem, 429, for an address that tried too many (``physworld_services.api.attempts``), and
        StorageError.
        """
        wait = self._attempts.wait_s(address, token)
        if wait:
            raise ApiProblem(
                429,
                "too_many_attempts",
                f"too many wrong keys from this address; try again in {wait} s",
                headers={"Retry-After": str(wait)},
            )
        with self._database.reading() as session:
            found = api_keys.verify(session, token)
        if found is not None:
            self._attempts.right(token)
        elif self._attempts.wrong(address) == PER_ADDRESS:
            log.warning("too_many_wrong_keys", client=address, in_seconds=WINDOW_S)
            self.record("attempts.limited", address)
        return found

    def record(self, action: str, address: str | None) -> None:
        """Tell the audit log of a stranger's attempt, within its limits."""
        if self._attempts.may_record():
            with self._database.session() as session:
                audit.record(session, Actor(None, address), action, None)


class Authentication:
    """ASGI middleware: puts the key behind the request into its state, or answers 401, 403 or 429."""

    def __init__(self, app: ASGIApp, gate: Gate, prefix: str) -> None:
        self.app = app
        self.gate = gate
        self.prefix = prefix

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let the request through if its key has the role that method and path ask for."""
        if scope["type"] != "http" or not _is_below(scope["path"], self.prefix):
            await self.app(scope, receive, send)
            return
        state = scope.setdefault("state", {})
        try:
            header = Headers(scope=scope).get("Authorization")
            principal = await run_in_threadpool(self._principal, header, address_of(scope))
            _require(principal, required_role(scope["method"], scope["path"], self.prefix))
        except ApiProblem as problem:
            state["unlogged"] = problem.status_code == 429  # a flood fills no log
            await answer(problem, scope)(scope, receive, send)
            return
        state["principal"] = principal
        state["key_id"] = principal.id
        state["credential"] = principal.credential
        await self.app(scope, receive, send)

    def _principal(self, header: str | None, address: str | None) -> Principal:
        scheme, _, token = (header or "").partition(" ")
        if scheme.lower() != "bearer" or not token:
            raise ApiProblem(
                401,
                "unauthenticated",
                "this address needs the header Authorization: Bearer <API key>",
                headers=_CHALLENGE,
            )
        try:
            found = self.gate.key_of(token.strip(), address)
        except StorageError as error:
            log.error(error.code, error=str(error))
            raise ApiProblem(503, error.code, error.told, headers={"Retry-After": "2"}) from error
        if found is None:
            raise ApiProblem(
                401,
                "unauthenticated",
                "the API key is unknown, revoked or expired",
                headers={"WWW-Authenticate": f'{_CHALLENGE["WWW-Authenticate"]}, error="invalid_token"'},
            )
        return found


def address_of(scope: Mapping[str, Any]) -> str | None:
    """The address that the request came from; behind a proxy that is trusted, the one that it names."""
    client = scope.get("client")
    return client[0] if client else None


def required_role(method: str, path: str, prefix: str) -> Role:
    """The role that a request needs."""
    if _is_below(path, f"{prefix}/keys") or _is_below(path, f"{prefix}/audit"):
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
