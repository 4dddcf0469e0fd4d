"""The inference service's own small HTTP and WebSocket interface; the REST API stands before it.

``POST /rollouts``   a RolloutCreate whose version is a number → a Rollout with its arrays, or a problem
``WS /live``         a live session (``live``)
``GET /health``      200

Every request carries a ticket that the API issued for it (``physworld_storage.access.tickets``): the service trusts
nobody for being on the same network. Rollouts run in a thread of their own, one at a time, so that sessions keep their
pace.
"""

from __future__ import annotations

import json
from typing import Any

import anyio
import structlog
from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route, WebSocketRoute

from physworld.worldmodel.errors import ControlsInvalid, VersionUnreadable, WorldModelError
from physworld_schemas.arrays import EncodedArray
from physworld_schemas.base import FieldError, Problem
from physworld_schemas.rollout import MAX_REQUEST_BYTES, Rollout, RolloutCreate
from physworld_services.inference import rollouts
from physworld_services.inference.live import LiveSessions
from physworld_services.inference.models import Models
from physworld_storage.access import tickets
from physworld_storage.artifacts import ArtifactStore
from physworld_storage.database import Database
from physworld_storage.errors import ArtifactCorrupt, Conflict, NotFound, StorageError
from physworld_storage.patience import ANSWERING
from physworld_storage.settings import Settings

TICKET_HEADER = "X-Physworld-Ticket"
PARALLEL_ROLLOUTS = 1

log = structlog.get_logger("physworld.inference")


def create_app(settings: Settings, database: Database) -> Starlette:
    """The application on an opened database."""
    models = Models(database, ArtifactStore(settings, ANSWERING))
    service = _Service(database, models)
    sessions = LiveSessions(database, models, device=settings.device)

    routes = [
        Route("/rollouts", service.rollout, methods=["POST"]),
        Route("/health", lambda request: Response("ok"), methods=["GET"]),
        WebSocketRoute("/live", sessions.serve),
    ]
    return Starlette(routes=routes)


class _Service:
    def __init__(self, database: Database, models: Models) -> None:
        self._database, self._models = database, models
        self.slots = anyio.CapacityLimiter(PARALLEL_ROLLOUTS)

    async def rollout(self, request: Request) -> Response:
        """Answer one rollout."""
        if int(request.headers.get("Content-Length", MAX_REQUEST_BYTES + 1)) > MAX_REQUEST_BYTES:
            return _problem(
                413, "content_too_large", f"more than {MAX_REQUEST_BYTES} bytes, or of unknown length"
            )
        ticket = request.headers.get(TICKET_HEADER, "")
        body = await request.body()
        try:
            return await anyio.to_thread.run_sync(self._answer, ticket, body, limiter=self.slots)
        except (StorageError, WorldModelError) as error:
            return problem_of(error)

    def _answer(self, ticket: str, body: bytes) -> Response:
        try:
            asked = RolloutCreate.model_validate_json(body)
        except ValidationError as error:
            return _problem(422, "invalid_request", str(error))
        with self._database.session() as session:
            known = tickets.redeem(session, ticket, subject_of("rollout", asked.model, asked.version))
        if known is None:
            return _problem(401, "unauthenticated", "the ticket is unknown, over or for something else")
        version, model = self._models.get(asked.model, asked.version)
        prepared = rollouts.prepare(asked, model)
        arrays, seconds = rollouts.run(asked, model, prepared)
        answer = Rollout(
            model=asked.model,
            version=version.version,
            sha256=version.sha256,
            seconds=seconds,
            **{name: EncodedArray.of(values) for name, values in arrays.items()},
            **rollouts.facts(asked, model, prepared),
        )
        return Response(answer.model_dump_json(), media_type="application/json")


def subject_of(what: str, model: str, version: int | str) -> str:
    """What a ticket of the API to this service is for."""
    return f"{what}:{model}:{version}"


def problem_of(error: StorageError | WorldModelError) -> Response:
    """A problem document for what the work said."""
    if isinstance(error, ControlsInvalid):
        fault = FieldError(loc=["body", error.field], msg=str(error))
        return _problem(422, "invalid_request", str(error), [fault])
    if isinstance(error, VersionUnreadable):
        return _problem(409, error.code, str(error))
    if isinstance(error, WorldModelError):
        return _problem(422, "rollout_diverged", str(error))
    status = {NotFound: 404, Conflict: 409, ArtifactCorrupt: 500}.get(type(error), 503)
    return _problem(status, error.code, error.told)


def _problem(status: int, code: str, detail: str, errors: list[FieldError] | None = None) -> Response:
    problem = Problem(title=code, status=status, code=code, detail=detail, errors=errors or [])
    content: dict[str, Any] = json.loads(problem.model_dump_json())
    headers = {"Retry-After": "2"} if status == 503 else None
    return JSONResponse(content, status, headers, media_type="application/problem+json")
