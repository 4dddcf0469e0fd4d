"""Clients that send half a request and nothing more: they are let go, and nobody else notices them."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket
from websockets.sync.client import connect

from physworld_services import connections
from physworld_services.web import create_app
from physworld_storage.database import open_database
from physworld_storage.settings import Settings

HALF = b"GET /health/live HTTP/1.1\r\nHost: here\r\nX-Never: "
SOCKETS = 60
PATIENCE_S = 0.5
WITHIN_S = 20.0


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, int]]:
    """Host and port of a server whose patience is short."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("data"))
    open_database(settings).upgrade()
    with socket.create_server(("127.0.0.1", 0)) as listening, pytest.MonkeyPatch.context() as patch:
        patch.setattr(connections, "HEADERS_S", PATIENCE_S)
        patch.setattr(connections, "BODY_S", PATIENCE_S)
        config = uvicorn.Config(create_app(settings), http=connections.Connection, log_config=None)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        while not server.started:
            time.sleep(0.02)
        yield listening.getsockname()
        server.should_exit = True
        thread.join()


def _rest(connection: socket.socket) -> bytes:
    """What comes until the server closes the connection; a reset is what unread bytes make of its end."""
    connection.settimeout(WITHIN_S)
    parts = []
    with suppress(ConnectionResetError):
        while part := connection.recv(65536):
            parts.append(part)
    return b"".join(parts)


def _half(address: tuple[str, int], text: bytes = HALF) -> socket.socket:
    connection = socket.create_connection(address)
    connection.sendall(text)
    return connection


def test_half_sent_headers_are_closed_and_others_are_served(address: tuple[str, int]) -> None:
    halves = [_half(address) for _ in range(SOCKETS)]
    host, port = address
    assert httpx.get(f"http://{host}:{port}/health/live", trust_env=False).status_code == 200
    for connection in halves:
        assert _rest(connection).startswith(b"HTTP/1.1 408 ")
        connection.close()


def test_a_second_request_on_a_kept_connection_has_no_more_time(address: tuple[str, int]) -> None:
    with _half(address, b"GET /health/live HTTP/1.1\r\nHost: here\r\n\r\n") as connection:
        assert connection.recv(65536).startswith(b"HTTP/1.1 200 ")
        connection.sendall(HALF)
        assert b"HTTP/1.1 408 " in _rest(connection)


def test_a_body_that_stops_coming_is_not_waited_for(address: tuple[str, int]) -> None:
    head = b"POST /dashboard/login HTTP/1.1\r\nHost: here\r\nContent-Length: 1000\r\n\r\nkey=half"
    with _half(address, head) as connection:
        assert b"HTTP/1.1 200 " not in _rest(connection)


def test_a_request_that_comes_in_pieces_is_answered(address: tuple[str, int]) -> None:
    with socket.create_connection(address) as connection:
        for piece in (b"GET /health/live HTTP/1.1\r\n", b"Host: here\r\n", b"Connection: close\r\n\r\n"):
            connection.sendall(piece)
            time.sleep(0.05)
        assert _rest(connection).startswith(b"HTTP/1.1 200 ")


def test_of_too_many_half_sent_headers_the_oldest_are_closed(
    address: tuple[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "HEADERS_S", 4 * WITHIN_S)
    monkeypatch.setattr(connections, "MOST_WAITING", 5)
    halves = [_half(address) for _ in range(8)]
    for connection in halves[:3]:
        _rest(connection)
    halves[-1].settimeout(0.2)
    with pytest.raises(TimeoutError):
        halves[-1].recv(1)
    for connection in halves:
        connection.close()


def test_both_servers_of_the_web_process_are_so_patient() -> None:
    folder = Path(__file__).parents[3] / "services"
    for name in ("web.py", "embedded/web.py"):
        assert "http=Connection" in (folder / name).read_text()


async def _answer_each(socket: WebSocket) -> None:
    await socket.accept()
    async for text in socket.iter_text():
        await socket.send_text(text)


def test_a_websocket_that_is_open_for_longer_is_no_body_that_does_not_come(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connections, "BODY_S", PATIENCE_S)
    app = Starlette(routes=[WebSocketRoute("/", _answer_each)])
    with socket.create_server(("127.0.0.1", 0)) as listening:
        config = uvicorn.Config(app, http=connections.Connection, ws=connections.Session, log_config=None)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        while not server.started:
            time.sleep(0.02)
        with connect(f"ws://127.0.0.1:{listening.getsockname()[1]}/", proxy=None) as client:
            time.sleep(3 * PATIENCE_S)
            client.send("still here")
            assert client.recv(timeout=WITHIN_S) == "still here"
        server.should_exit = True
        thread.join()
