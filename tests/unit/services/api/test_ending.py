"""Endings: one query for everything that is open, none for nothing, and a database that is away ends nothing."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event

from physworld_services.api import ending
from physworld_services.api.ending import Endings, EndWithCredential
from physworld_storage.access import api_keys
from physworld_storage.database import Database, open_database
from physworld_storage.errors import DatabaseUnavailable
from physworld_storage.settings import Settings

SHORT_S = 0.05


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    opened = open_database(Settings(data_dir=tmp_path))
    opened.upgrade()
    yield opened
    opened.dispose()


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ending, "CHECK_S", SHORT_S)


@pytest.fixture
def queries(database: Database) -> list[str]:
    """Every SELECT that is sent."""
    sent: list[str] = []

    def note(connection: Any, cursor: Any, statement: str, *rest: Any) -> None:
        if statement.startswith("SELECT"):
            sent.append(statement)

    event.listen(database.engine, "before_cursor_execute", note)
    return sent


def keys(database: Database, count: int) -> list[api_keys.ApiKey]:
    with database.session() as session:
        return [api_keys.create_key(session, "robot", "write")[0] for _ in range(count)]


def revoke(database: Database, key: api_keys.ApiKey) -> None:
    with database.session() as session:
        api_keys.revoke_key(session, key.id)


def test_fifty_streams_ask_as_one_and_none_asks_nothing(database: Database, queries: list[str]) -> None:
    made = keys(database, 50)
    queries.clear()

    async def work() -> tuple[int, int]:
        endings = Endings(database)
        async with AsyncExitStack() as streams:
            for key in made:
                await streams.enter_async_context(endings.of(key.credential))
            await asyncio.sleep(4.5 * SHORT_S)
            open_count = len(queries)
        await asyncio.sleep(4 * SHORT_S)
        queries.clear()
        await asyncio.sleep(4 * SHORT_S)
        return open_count, len(queries)

    while_open, afterwards = asyncio.run(work())
    assert 1 <= while_open <= 5
    assert afterwards == 0


def test_only_what_the_ended_credential_opened_ends(database: Database) -> None:
    first, second = keys(database, 2)

    async def work() -> None:
        endings = Endings(database)
        async with (
            endings.of(first.credential) as one,
            endings.of(first.credential) as two,
            endings.of(second.credential) as other,
        ):
            await asyncio.to_thread(revoke, database, first)
            await asyncio.wait_for(asyncio.gather(one.wait(), two.wait()), 30.0)
            assert not other.is_set()

    asyncio.run(work())


def test_while_the_database_is_away_nothing_ends_and_afterwards_it_is_asked_again(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    (key, _) = keys(database, 2)
    asked = asyncio.Event()

    def away(session: object, credentials: set[str]) -> set[str]:
        asked.set()
        raise DatabaseUnavailable("away")

    async def work() -> None:
        endings = Endings(database)
        async with endings.of(key.credential) as ended:
            with monkeypatch.context() as outage:
                outage.setattr(ending.credentials, "active", away)
                await asyncio.to_thread(revoke, database, key)
                await asyncio.sleep(4 * SHORT_S)
                assert asked.is_set() and not ended.is_set()
            await asyncio.wait_for(ended.wait(), 30.0)

    asyncio.run(work())


def test_a_response_that_does_not_listen_costs_no_check(database: Database) -> None:
    endings = Endings(database)

    async def application(scope: dict, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"done"})

    sent: list[dict] = []

    async def send(message: Any) -> None:
        sent.append(message)

    async def receive() -> Any:
        raise AssertionError("nobody asked")

    scope = {"type": "http", "state": {"credential": "x"}}
    asyncio.run(EndWithCredential(application, endings)(scope, receive, send))  # type: ignore[arg-type]
    assert [message["type"] for message in sent] == ["http.response.start", "http.response.body"]
    assert endings._checking is None


@pytest.mark.parametrize(
    ("kind", "told"), [("text/event-stream; charset=utf-8", True), ("application/zip", False)]
)
def test_a_stream_of_events_is_told_and_ended_and_a_file_is_finished(
    database: Database, kind: str, told: bool
) -> None:
    key, _ = keys(database, 2)
    sent: list[dict] = []

    async def work() -> str:
        never = asyncio.Event()
        given = [{"type": "http.request", "body": b"", "more_body": False}]

        async def receive() -> Any:
            if given:
                return given.pop()
            await never.wait()

        async def application(scope: Any, receive: Any, send: Any) -> None:
            headers = [(b"content-type", kind.encode())]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            assert (await receive())["type"] == "http.request"
            await send({"type": "http.response.body", "body": b"half", "more_body": True})
            heard = asyncio.create_task(receive())
            await asyncio.to_thread(revoke, database, key)
            done, _ = await asyncio.wait({heard}, timeout=30.0 if told else 6 * SHORT_S)
            heard.cancel()
            if not done:
                await send({"type": "http.response.body", "body": b" and half", "more_body": False})

        async def send(message: Any) -> None:
            sent.append(message)

        scope = {"type": "http", "state": {"credential": key.credential}}
        await EndWithCredential(application, Endings(database))(scope, receive, send)
        return "".join(message.get("body", b"").decode() for message in sent)

    assert asyncio.run(work()) == ("half" if told else "half and half")
    assert sent[-1]["more_body"] is False
