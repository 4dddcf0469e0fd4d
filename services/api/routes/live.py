"""Live sessions: a ticket over HTTP, then a WebSocket that is handed through to the inference service.

A program may connect with its key in the header instead of a ticket. Nothing is computed here: frames pass as they
come, and a client that reads slowly slows the inner connection, whose sender then leaves frames out. One that takes
nothing for ``SEND_S`` is let go here as there: its own connection may hang for minutes before the system gives it up.
A session ends (1008) within seconds of the key, token or browser's session that opened it
(``physworld_services.api.ending``).
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Any
from urllib.parse import urlencode

import structlog
from fastapi import APIRouter, Response, WebSocket
from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocketState
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException

from physworld_schemas.live import LiveTicket, LiveTicketCreate, close_reason
from physworld_services.api.dependencies import DatabaseDep, PrincipalDep, SettingsDep
from physworld_services.api.ending import Endings
from physworld_services.api.errors import ApiProblem, documented
from physworld_services.api.idempotency import IdempotencyDep, answer_of
from physworld_services.api.inference import unavailable
from physworld_services.api.routes.rollouts import ready_version
from physworld_services.api.security import Gate, address_of
from physworld_storage import registry
from physworld_storage.access import tickets
from physworld_storage.access.api_keys import ApiKey
from physworld_storage.database import Database
from physworld_storage.errors import NotFound, StorageError
from physworld_storage.idempotency import Answer
from physworld_storage.settings import Settings

router = APIRouter(prefix="/live", tags=["live"])
sockets = APIRouter()

MESSAGE_BYTES = 64 * 1024
FIRST_MESSAGE_BYTES = 64 * 2**20  # it lists the body's points as text; the SDK reads as much
POLICY, UNAVAILABLE, TOO_BIG, TOO_SLOW = 1008, 1013, 1009, 4409
OPEN_S = 60.0  # the inference service loads torch at its first session
CLOSE_S = 1.0  # for the inference service to take leave; it may be held up by frames that nobody reads
SEND_S, CLOSE_S = 10.0, 1.0
PASSED_CODES = frozenset({1000, 1001, 1007, 1008, 1013, *range(4000, 5000)})

log = structlog.get_logger("physworld.live")


@router.post(
    "/tickets",
    status_code=201,
    response_model=LiveTicket,
    responses=documented(401, 403, 404, 409, 413, 422, 503),
)
def create_ticket(
    body: LiveTicketCreate,
    idempotency: IdempotencyDep,
    database: DatabaseDep,
    settings: SettingsDep,
    principal: PrincipalDep,
) -> Response:
    """A ticket for one live session, good for one connection within a minute. A replay holds no ticket."""
    made = issue(database, settings, principal.credential, body.model, body.version)
    return idempotency.run(body, lambda session: answer_of(201, made), stored=_without_ticket)


def issue(
    database: Database, settings: Settings, credential: str, model: str, version: int | str
) -> LiveTicket:
    """The ticket and the address that takes it.

    Args:
        database: gives out the ticket.
        settings: where the inference service is.
        credential: of the caller, as ``ApiKey.credential``.
        model: its name.
        version: its number, or an alias.

    Raises:
        NotFound: there is no such version.
        ApiProblem: 409 for a version that is not ready, 503 without an inference service.
    """
    with database.session() as session:
        found = ready_version(registry.get_version(session, model, version))
        if not settings.inference_url:
            raise unavailable("no inference service belongs to this installation")
        ticket, until = tickets.issue(session, credential, _subject(model, found.version))
    query = urlencode({"model": model, "version": found.version, "ticket": ticket})
    return LiveTicket(
        ticket=ticket, model=model, version=found.version, expires_at=until, path=f"/v1/live?{query}"
    )


@sockets.websocket("/live")
async def live(socket: WebSocket) -> None:
    """A live session of a model version; ``physworld_schemas.live`` and docs/rollouts.md tell the messages."""
    settings: Settings = socket.app.state.settings
    database: Database = socket.app.state.database
    query = socket.query_params
    model, version = query.get("model", ""), query.get("version", "")
    header, ticket = socket.headers.get("Authorization", ""), query.get("ticket", "")
    await socket.accept()
    if not settings.inference_url:
        await socket.close(UNAVAILABLE, "no inference service belongs to this installation")
        return
    try:
        key = await run_in_threadpool(_bearer, socket, header) if not ticket else None
        entry = await run_in_threadpool(_enter, database, model, version, ticket, key)
    except (StorageError, ApiProblem) as error:
        detail = error.detail if isinstance(error, ApiProblem) else str(error)
        await socket.close(POLICY, close_reason(error.code, detail))
        return
    if entry is None:
        needed = "a ticket of POST /v1/live/tickets, or a key that may write, is needed"
        await socket.close(POLICY, close_reason("unauthenticated", needed))
        return
    credential, inner_query = entry
    inner_query |= {"frames": query.get("frames", "1")[:2], "part": query.get("part", "points")[:10]}
    endings: Endings = socket.app.state.endings
    address = f"{settings.inference_url.replace('http', 'ws', 1)}/live?{urlencode(inner_query)}"
    try:
        async with endings.of(credential) as ended:
            inner = await connect(
                address,
                compression=None,
                proxy=None,
                open_timeout=OPEN_S,
                close_timeout=CLOSE_S,
                max_queue=2,
                max_size=FIRST_MESSAGE_BYTES,
            )
            try:
                await _relay(socket, inner, ended)
                await inner.close()
            finally:  # also where the server is stopping and nothing may be waited for
                inner.transport.abort()
    except (OSError, TimeoutError, WebSocketException) as error:
        log.warning("live_session_not_opened", error=str(error))
        with suppress(RuntimeError):
            await socket.close(UNAVAILABLE, "the inference service does not answer")


def _without_ticket(answer: Answer) -> Answer:
    made = LiveTicket.model_validate_json(answer.body)
    return answer_of(answer.status, made.model_copy(update={"ticket": "", "path": ""}), answer.headers)


def _subject(model: str, version: int) -> str:
    return f"session:{model}:{version}"


def _bearer(socket: WebSocket, header: str) -> ApiKey | None:
    """The key in the header, if it may write. Raises ApiProblem, 429, and StorageError."""
    scheme, _, token = header.partition(" ")
    if scheme.lower() != "bearer" or not token:
        return None
    gate: Gate = socket.app.state.gate
    key = gate.key_of(token.strip(), address_of(socket.scope))
    return key if key is not None and key.allows("write") else None


def _enter(
    database: Database, model: str, version: str, ticket: str, key: ApiKey | None
) -> tuple[str, dict[str, Any]] | None:
    """The credential of whoever may open a session and the inner connection's query; None for others, whatever exists.

    Raises NotFound, but only for the holder of a key.
    """
    with database.session() as session:
        number = 0
        if ticket:
            with suppress(NotFound):
                number = registry.get_version(session, model, version).version
                key = tickets.redeem(session, ticket, _subject(model, number))
        elif key is not None:
            number = registry.get_version(session, model, version).version
        if key is None:
            return None
        inner, _ = tickets.issue(session, key.credential, f"live:{model}:{number}")
    return key.credential, {"model": model, "version": number, "ticket": inner}


async def _relay(socket: WebSocket, inner: ClientConnection, ended: asyncio.Event) -> None:
    """Hand messages through until one side ends, then end the other with the same words; or until ``ended``."""

    async def up() -> tuple[int, str]:
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return 0, ""
            data: bytes | str = message.get("bytes") or message.get("text") or b""
            if len(data) > MESSAGE_BYTES:
                return TOO_BIG, f"a message of {len(data)} bytes; {MESSAGE_BYTES} are the most"
            await inner.send(data)

    async def down() -> tuple[int, str]:
        while True:
            message = await inner.recv()
            sending = socket.send_bytes(message) if isinstance(message, bytes) else socket.send_text(message)
            try:
                async with asyncio.timeout(SEND_S):
                    await sending
            except TimeoutError:
                return TOO_SLOW, f"a frame was not taken within {SEND_S:g} s"

    async def over() -> tuple[int, str]:
        await ended.wait()
        return POLICY, close_reason("unauthenticated", "the key or session that opened this is over")

    tasks = [asyncio.create_task(work()) for work in (up, down, over)]
    done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    first = next(iter(done))
    error = first.exception()
    if error is None:
        code, reason = first.result()
    elif isinstance(error, ConnectionClosed):
        closed = error.rcvd
        code, reason = UNAVAILABLE, "the inference service broke the session off"
        if closed is not None and closed.code in PASSED_CODES:
            code, reason = closed.code, closed.reason
    else:
        code, reason = 0, ""
    if code and socket.application_state is WebSocketState.CONNECTED:
        with suppress(RuntimeError, TimeoutError):
            async with asyncio.timeout(CLOSE_S):
                await socket.close(code, reason)
