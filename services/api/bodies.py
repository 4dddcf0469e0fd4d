"""JSON bodies that may be long are parsed in a worker thread: the event loop has a turn before they are checked."""

from __future__ import annotations

import json
from collections.abc import Callable, Coroutine
from typing import Any

from fastapi import Request, Response
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool


class LongBodyRoute(APIRoute):
    """A route whose JSON body is parsed off the event loop. ``physworld_services.api.limits`` bounds how long that
    takes."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The route's handler on a request that parses elsewhere."""
        handle = super().get_route_handler()

        async def handle_elsewhere(request: Request) -> Response:
            return await handle(_Elsewhere(request.scope, request.receive))

        return handle_elsewhere


class _Elsewhere(Request):
    async def json(self) -> Any:
        """The body's value. Raises json.JSONDecodeError."""
        return await run_in_threadpool(json.loads, await self.body())
