"""Request ids, the JSON access log, the request metrics and the headers of every answer: one middleware around all.

A client may send ``X-Request-Id`` (letters, digits, ``._-``, at most 64); otherwise the service makes one.
The answer carries it, every problem carries it, every log line of the request carries it.
"""

from __future__ import annotations

import re
import time

import structlog
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from physworld_schemas.ids import new_id
from physworld_services.api.metrics import Metrics
from physworld_services.api.security import address_of

_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
_UNLOGGED = frozenset({"/health/live", "/health/ready", "/metrics"})

# What a browser may do with an answer of the API, which is data: nothing. The page at /docs has a script in itself.
_SCRIPTS = "'self' 'unsafe-inline'"
_DATA_POLICY = "default-src 'none'; frame-ancestors 'none'"
_DOCS_POLICY = (
    f"default-src 'none'; script-src {_SCRIPTS}; style-src {_SCRIPTS}; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_TLS_ONLY = "max-age=31536000; includeSubDomains"

log = structlog.get_logger("physworld.access")


class Access:
    """ASGI middleware; the outermost of ours, so that refusals are logged and counted too."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app = app
        self.metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Give the request its id, run it, count it and log one line."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request_id = _request_id(Headers(scope=scope))
        scope.setdefault("state", {})["request_id"] = request_id
        status = 500

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-Id"] = request_id
                _protect(headers, scope)
            await send(message)

        started = time.perf_counter()
        with structlog.contextvars.bound_contextvars(request_id=request_id):
            try:
                await self.app(scope, receive, send_with_id)
            except Exception:
                log.exception("request_failed", method=scope["method"], path=scope["path"])
                raise
            finally:
                self._account(scope, status, time.perf_counter() - started)

    def _account(self, scope: Scope, status: int, seconds: float) -> None:
        method = scope["method"] if scope["method"] in _METHODS else "other"
        route = _route_of(scope)
        self.metrics.requests.labels(method, route, str(status)).inc()
        self.metrics.latency.labels(method, route).observe(seconds)
        if scope["path"] in _UNLOGGED or scope["state"].get("unlogged"):
            return
        log.info(
            "request",
            method=scope["method"],
            path=scope["path"],
            status=status,
            seconds=round(seconds, 6),
            client=address_of(scope),
            key=scope["state"].get("key_id"),
        )


def _protect(headers: MutableHeaders, scope: Scope) -> None:
    """Say what browsers and caches may do with an answer, where its route has not said it."""
    headers.setdefault("X-Content-Type-Options", "nosniff")
    headers.setdefault("Referrer-Policy", "no-referrer")
    policy = _DOCS_POLICY if scope["path"].startswith("/docs") else _DATA_POLICY
    headers.setdefault("Content-Security-Policy", policy)
    if scope["path"].startswith("/v1"):
        headers.setdefault("Cache-Control", "no-store")
    if scope.get("scheme") == "https":
        headers.setdefault("Strict-Transport-Security", _TLS_ONLY)


def _request_id(headers: Headers) -> str:
    sent = headers.get("X-Request-Id", "")
    return sent if _REQUEST_ID.fullmatch(sent) else new_id("request")


def _route_of(scope: Scope) -> str:
    """The path's template, so that ids do not become labels; unknown paths share one label.

    A route knows its path below the routers that include it; what stands before it is in the request.
    """
    template = getattr(scope.get("route"), "path", None)
    if template is None:
        return "unmatched"
    if ":path}" in template:
        return str(template)
    above = scope["path"].split("/")[: -template.count("/") or None]
    return "/".join(above) + str(template)
